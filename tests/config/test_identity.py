"""A trial's identity is what deviates from the constructors' defaults and affects its result."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path

import pytest
from conftest import rest_slow

from simbias.config import ConfigError, compose
from simbias.config.build import build
from simbias.sweep.grid import expand

OWN_BIAS = """
from simbias.learning.bias.none import NoBias

class Mine(NoBias):
    {version}
    def __init__(self, strength: float{arguments}) -> None: ...
"""


def own(folder: Path, arguments: str = "", version: str = "", more: str = "") -> str:
    """The identity of a trial with a bias of one's own."""
    (folder / "own_bias.py").write_text(
        textwrap.dedent(OWN_BIAS.format(arguments=arguments, version=version))
    )
    (folder / "conf" / "bias").mkdir(parents=True, exist_ok=True)
    (folder / "conf" / "bias" / "mine.yaml").write_text(f"_target_: own_bias.Mine\nstrength: 1.0\n{more}")
    sys.modules.pop("own_bias", None)
    composition = compose(["bias=mine"], folder / "conf")
    build(composition)
    return composition.hash


@pytest.mark.slow
def test_an_option_added_with_its_old_behaviour_as_default_changes_no_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    before = own(tmp_path)
    assert own(tmp_path, ", memory: int = 0") == before
    assert own(tmp_path, ", memory: int = 0", more="memory: 0\n") == before
    assert own(tmp_path, ", memory: int = 0", more="memory: 1\n") != before
    assert own(tmp_path, ", limits: dict[str, float] | None = None", more="limits: null\n") == before
    assert own(tmp_path, version="version = 2") != before


@pytest.mark.slow
@pytest.mark.parametrize(
    "override",
    [
        "bias.d=1",  # an integer for a float
        "hardware.noise.torque_variance=0",
        "hardware.iterations=50",
        "method.experiments=2",
        "tracking=none",
        "tracking.experiment=other",
        "engine=sequential",
        "engine.n_jobs=7",
        "experiment_timeout=3",
        "preset=paper",
    ],
)
def test_what_changes_no_result_changes_no_identity(override: str) -> None:
    assert compose([override]).hash == compose([]).hash


@pytest.mark.parametrize(
    "override",
    rest_slow(
        5,
        [
            "seed=1",
            "bias.d=2",
            "bias=none",
            "hardware.noise.torque_variance=0.1",
            "task.robot.leg_length=0.4",
            "bias=sparse_gp",
            "hardware.inertia_error=0.2",
            "task.start.deviation=0.01",
            "optimizer.max_evaluations=999",
            "optimizer=nlopt_crs",
            "samples.limits.speed=7",
            "samples.window.measured=1",
            "method=model_based",
            "preset=robust",
        ],
    ),
)
def test_what_may_change_a_result_changes_the_identity(override: str) -> None:
    assert compose([override]).hash != compose([]).hash


def test_a_preset_is_the_same_as_its_options_one_by_one() -> None:
    options = [
        "bias=held_out",
        "identification=posterior",
        "evaluation=domain_randomization_30s",
        "method=model_selection",
    ]
    options += ["optimizer=hybrid_from_candidates"]
    assert compose(["preset=robust"]).hash == compose(options).hash
    assert compose(["preset=robust", "bias=none"]).hash == compose(["bias=none", *options[1:]]).hash


def test_a_cell_is_all_but_the_seed() -> None:
    assert compose(["seed=1"]).cell == compose(["seed=2"]).cell != compose(["bias=none"]).cell


def test_a_bad_value_is_one_line() -> None:
    with pytest.raises(ConfigError, match=r"^bias\.d: must be greater than 0, got -1$"):
        _ = compose(["bias.d=-1"]).hash


@pytest.mark.parametrize(
    ("override", "key"),
    rest_slow(
        2,
        [
            ("hardware.noise={torque_variance: 0.1}", "hardware.noise"),
            ("hardware.noise.torque_variance=0.1", "hardware.noise.torque_variance"),
            ("~hardware.noise", "hardware.noise"),
            ("hardware.inertia_error=0.1", "hardware.inertia_error"),
        ],
    ),
)
def test_an_override_of_an_axis_or_what_is_around_it_is_refused(override: str, key: str) -> None:
    with pytest.raises(ConfigError, match=rf"^{key}: is an axis of the sweep"):
        expand(["+sweep=table2", override])


def test_an_override_of_another_group_is_none_of_the_axis() -> None:
    assert len(expand(["+sweep=table2", "hardware=pymunk", "sweep.trials=1"]).trials) == 24
