"""Every shipped component goes through the conformance suite."""

from __future__ import annotations

import pytest
from shipped import GROUPS, overrides

import simbias
from simbias.config import options
from simbias.testing.conformance import verdicts

SHORT = ["tracking=none", "task.horizon=120"]  # swing-ups hold for 100 frames


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::simbias.core.SlowWarning")
@pytest.mark.parametrize("group", GROUPS)
def test_every_shipped_component_keeps_its_contract(group: str, uncompiled: None) -> None:
    """Robots have theirs in `tests/robots`."""
    for option in options()[group]:
        study = simbias.load([*overrides(group, option), *SHORT])
        assert {verdict.problem for verdict in verdicts(study, {group})} == {""}, option
