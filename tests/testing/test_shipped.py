"""Every shipped option and preset builds, and every component goes through the conformance suite."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import zip_longest
from typing import get_type_hints

import pytest
from in_numpy import predict_in_numpy
from shipped import GROUPS, NEEDED, overrides, shipped, shortened

from simbias.config import Composition, compose, options
from simbias.config.build import build
from simbias.testing.conformance import verdicts
from simbias.trial.study import Study

SHORT_WINDOW = "identification.window=0.02"
LIKE_POSTERIOR = (  # whose own identifications are that class with motors, as the reacher's
    *("acrobot_swingup", "arm_eight", "ball_in_cup", "cartpole_swingup", "hopper", "pendulum_swingup"),
)
NO_MORE_THAN_BUILT = {
    (f"preset={name}", *NEEDED.get(f"preset={name}", []), SHORT_WINDOW) for name in LIKE_POSTERIOR
}
ROBOTS = {
    *("cartpole", "double_cartpole", "acrobot", "biped", "pendulum_swingup", "cartpole_swingup"),
    *("reacher", "ball_in_cup", "hopper"),
}
OF_A_ROBOT = {"task", "nominal", "hardware", "policy"}


def wanted() -> dict[tuple[str, ...], set[str]]:
    """What is composed, and which of its groups are options of their own: robots share compositions."""
    found: dict[tuple[str, ...], set[str]] = {}
    for group, names in options().items():
        for option in names if group not in ("engine", "tracking") else ():
            presets = NEEDED.get(f"{group}={option}", []) if group == "preset" else []
            chosen = [f"preset={option}", *presets] if group == "preset" else overrides(group, option)
            if group == "identification" and "window" in shipped(group, option):
                chosen = [*chosen, SHORT_WINDOW]
            found.setdefault(tuple(chosen), set()).update({group} - {"preset"})
    return found


def compositions() -> Iterator[tuple[tuple[str, ...], set[str], Composition]]:
    """What is wanted and its composition; plain options one of each group at once, as Hydra takes a while."""
    together: dict[str, list[str]] = {}
    for chosen, groups in wanted().items():
        (first, *others), (group, *_) = chosen, [*groups, ""]
        if others or first.startswith("preset=") or "${" in str(shipped(group, first.partition("=")[2])):
            yield chosen, groups, compose(["tracking=none", *chosen])  # what it says depends on other groups
        else:
            together.setdefault(group, []).append(first)
    default = compose(["tracking=none"])
    for each in zip_longest(*together.values()):
        whole = compose(["tracking=none", *filter(None, each)])
        for group, option in zip(together, each, strict=True):
            if option is not None:
                config = {**default.config, group: whole.config[group]}
                choices = {**default.choices, group: whole.choices[group]}
                yield (option,), {group}, replace(default, config=config, choices=choices)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::simbias.core.StudyWarning")
def test_every_shipped_component_keeps_its_contract(
    uncompiled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    predict_in_numpy(monkeypatch)
    hints, robots = get_type_hints(Study), {f"preset={name}" for name in ROBOTS}
    for chosen, groups, composition in compositions():
        if "optimizer" not in groups:  # whose evaluations are nothing but its own
            composition = shortened(composition, 0.03 if SHORT_WINDOW in chosen else 0.0)
        study = build(composition)
        if chosen in NO_MORE_THAN_BUILT:
            fitted = study.identification.fit(study.nominal, [])
            assert {each.name for each in fitted.parameters} > {
                each.name for each in study.nominal.parameters
            }
            continue
        checked = groups & {*GROUPS} | (OF_A_ROBOT if robots & {*chosen} == {*chosen} else set())
        assert {verdict.problem for verdict in verdicts(study, checked)} <= {""}, chosen
        robots -= {*chosen}
        for group in groups - {*GROUPS}:
            assert isinstance(getattr(study, group), hints[group]), (group, chosen)
    assert not robots
