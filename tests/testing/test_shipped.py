"""Every shipped component goes through the conformance suite."""

from __future__ import annotations

import pytest
from in_numpy import predict_in_numpy
from shipped import GROUPS, overrides, shortened

from simbias.config import compose, options
from simbias.config.build import build
from simbias.testing.conformance import verdicts


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::simbias.core.SlowWarning")
@pytest.mark.parametrize("group", GROUPS)
def test_every_shipped_component_keeps_its_contract(
    group: str, uncompiled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Robots have theirs in `tests/robots`."""
    predict_in_numpy(monkeypatch)
    for option in options()[group]:
        shorter = ["identification.window=0.02"] if group == "identification" and option != "none" else []
        composition = compose(["tracking=none", *overrides(group, option), *shorter])
        if group != "optimizer":  # whose evaluations are nothing but its own
            composition = shortened(composition, 0.03 if shorter else 0.0)
        study = build(composition)
        assert {verdict.problem for verdict in verdicts(study, {group})} == {""}, option
