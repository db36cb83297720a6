"""A trial's identity is what deviates from the constructors' defaults and affects its result."""

import sys
import textwrap
from datetime import timedelta
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from texts import write

from simbias.config import ConfigError, Variations, compose
from simbias.config.build import build
from simbias.config.identity import identity_fields
from simbias.learning.bias.none import NoBias
from simbias.sweep.grid import expand

OWN_BIAS = """
from simbias.learning.bias.none import NoBias

class Mine(NoBias):
    {version}
    def __init__(self, strength: float{arguments}) -> None: ...
"""


def own(folder: Path, arguments: str = "", version: str = "", more: str = "") -> str:
    """The identity of a trial with a bias of one's own."""
    text = textwrap.dedent(OWN_BIAS.format(arguments=arguments, version=version))
    config = f"_target_: own_bias.Mine\nstrength: 1.0\n{more}"
    write(folder, {"own_bias.py": text, "conf/bias/mine.yaml": config})
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


class Tabled(NoBias):
    """A bias with a value of any type."""

    def __init__(self, table: Any = None) -> None: ...


def test_values_of_any_type_are_told_apart() -> None:
    """Arrays by all of their numbers, sets in any order; a value whose text tells less is refused."""

    def identity(table: object) -> dict[str, Any]:
        config = {"bias": {"_target_": f"{__name__}.Tabled", "table": table}}
        return identity_fields(config, (), [__name__])["bias"]

    array = np.linspace(0.0, 1.0, 1500)
    tables: list[tuple[Any, Any]] = [
        (array, array.tolist()),
        ({"b", "a"}, ["a", "b"]),
        (Path("a"), "a"),
        ((1, 2), [1, 2]),
        (np.float64(0.5), 0.5),
        (np.int64(3), 3),
        (timedelta(seconds=90), "0:01:30"),
        (Decimal("2.5"), "2.5"),
    ]
    for table, told in tables:
        assert identity(table) == {"class": f"{__name__}.Tabled", "table": told}
    with pytest.raises(ConfigError, match=r"^bias\.table: expected numbers, .*, got object$"):
        identity([object()])


THREE = np.int64(3)


class Counting(NoBias):
    """A bias whose defaults are of types that no config gives."""

    def __init__(self, count: Any = THREE, rule: Any = len) -> None: ...


def test_defaults_may_be_of_any_type() -> None:
    target = {"_target_": f"{__name__}.Counting"}
    whole = {"class": f"{__name__}.Counting"}
    for values, told in (({"count": 3}, {}), ({"count": 4}, {"count": 4}), ({"rule": None}, {"rule": None})):
        assert identity_fields({"bias": target | values}, (), [__name__])["bias"] == whole | told


@pytest.mark.slow
def test_what_changes_no_result_changes_no_identity() -> None:
    """Nor does a preset in place of its options, one by one."""
    base = compose().hash
    for overrides in (
        ["bias.d=1"],  # an integer for a float
        ["hardware.noise.torque_variance=0", "method.experiments=2", "preset=paper"],  # defaults
        ["tracking=none", "engine=sequential", "experiment_timeout=3"],
        ["tracking.experiment=other", "engine.n_jobs=7"],
        ["budget.experiments=null", "samples.stride=35"],  # frames; samples=thresholds has seconds
    ):
        assert compose(overrides).hash == base
    process = ["hardware=process", "hardware.command=drive"]
    other = ["hardware.timeout=600", "hardware.exclusive=false"]
    assert compose([*process, *other]).hash == compose(process).hash != base
    options = ["identification=posterior_forward", "evaluation=domain_randomization_30s"]
    options += ["method=model_selection", "optimizer=hybrid_from_candidates"]
    assert compose(["preset=robust"]).hash == compose(["bias=window_gp", *options]).hash
    assert compose(["preset=robust", "bias=none"]).hash == compose(["bias=none", *options]).hash
    known = "identification=posterior", "identification.known={parameters: [a], mode: [0], spread: [[1]]%s}"
    told = [known[0], known[1] % ", doubts: [[b]], learned: [c]"]
    assert compose(told).hash == compose([known[0], known[1] % ""]).hash != base
    for seed in ("01", "1e0", "'1'", "1.0"):
        assert compose([f"seed={seed}"]) == compose(["seed=1"])
    for one, other in (("seconds=10", "seconds=10.0"), ("experiments=5", "experiments=5.0")):
        assert compose([f"budget.{one}"]).hash == compose([f"budget.{other}"]).hash
    cells = [compose([override]).group_hash for override in ("seed=1", "seed=2", "bias=none")]
    assert cells[0] == cells[1] != cells[2]


@pytest.mark.slow
def test_what_may_change_a_result_changes_the_identity() -> None:
    overrides = [
        *("seed=1", "bias.d=2", "bias=none", "method=model_based", "hardware.noise.torque_variance=0.1"),
        *("task.robot.leg_length=0.4", "task.start.deviation=0.01", "optimizer.max_evaluations=999"),
        *("optimizer=nlopt_crs", "samples.limits.speed=7", "samples.window.measured=1"),
        *("budget.experiments=5", "samples=thresholds"),
    ]
    settings = [override.split("=") for override in overrides]
    variations = Variations()
    hashes = {variations.composition({key: yaml.safe_load(value)}).hash for key, value in settings}
    assert len(hashes - {compose().hash}) == len(overrides)


def test_a_change_of_one_value_of_an_argument_leaves_trials_with_others_as_they_are() -> None:
    """Bayesian optimisation changed, CMA-ES on the hardware did not."""
    cma, bayesian = (
        compose(["method=direct_search", f"method.strategy={each}"]).identity_fields["method"]
        for each in ("cma", "bayesian")
    )
    assert cma == {"class": "DirectSearch"}
    assert bayesian == {"class": "DirectSearch", "version": 2, "strategy": "bayesian"}


@pytest.mark.slow
def test_an_override_of_an_axis_or_what_is_around_it_is_refused() -> None:
    for override, key in (
        ("hardware.noise={torque_variance: 0.1}", "hardware.noise"),
        ("hardware.noise.torque_variance=0.1", "hardware.noise.torque_variance"),
        ("~hardware.noise", "hardware.noise"),
    ):
        with pytest.raises(ConfigError, match=rf"^{key}: is an axis of the sweep"):
            expand(["+sweep=fig6", override])
    assert len(expand(["+sweep=fig6", "hardware=pymunk", "sweep.trials=1"]).trials) == 2  # none of the axis
