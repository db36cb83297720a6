"""Every shipped option and preset builds, and every component goes through the conformance suite."""

from __future__ import annotations

from typing import get_type_hints

import pytest
from in_numpy import predict_in_numpy
from shipped import GROUPS, NEEDED, overrides, shortened

from simbias.config import compose, options
from simbias.config.build import build
from simbias.testing.conformance import verdicts
from simbias.trial.study import Study


def wanted() -> dict[tuple[str, ...], set[str]]:
    """What is composed, and which of its groups are options of their own: robots share compositions."""
    found: dict[tuple[str, ...], set[str]] = {}
    for group, names in options().items():
        for option in names if group not in ("engine", "tracking") else ():
            presets = NEEDED.get(f"{group}={option}", []) if group == "preset" else []
            chosen = [f"preset={option}", *presets] if group == "preset" else overrides(group, option)
            if group == "identification" and option != "none":
                chosen = [*chosen, "identification.window=0.02"]
            found.setdefault(tuple(chosen), set()).update({group} - {"preset"})
    return found


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::simbias.core.SlowWarning")
def test_every_shipped_component_keeps_its_contract(
    uncompiled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Robots have theirs in `tests/robots`."""
    predict_in_numpy(monkeypatch)
    hints = get_type_hints(Study)
    for chosen, groups in wanted().items():
        composition = compose(["tracking=none", *chosen])
        if "optimizer" not in groups:  # whose evaluations are nothing but its own
            composition = shortened(composition, 0.03 if "identification.window=0.02" in chosen else 0.0)
        study = build(composition)
        assert {verdict.problem for verdict in verdicts(study, groups & {*GROUPS})} <= {""}, chosen
        for group in groups - {*GROUPS}:
            assert isinstance(getattr(study, group), hints[group]), (group, chosen)
