import random
import re
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import ROOT
from errors import one_line
from hypothesis import given, settings
from hypothesis import strategies as st
from sweeping import write_sweep

from simbias.config import ConfigError, compose, sweeps
from simbias.sweep.axes import read_axis
from simbias.sweep.grid import Sweep, expand

VALUES = [0.0, 0.001, 0.1, 0.35, 1.5]
axis_values = st.lists(st.sampled_from(VALUES), min_size=1, max_size=3, unique=True)
MINE = """
sweep:
  trials: 1
  axes:
    torque: {keys: hardware.noise.torque_variance, values: []}
    error: {keys: hardware.inertia_error, values: []}
"""


@pytest.fixture(scope="module")
def conf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of configs with a sweep."""
    return write_sweep(tmp_path_factory.mktemp("mine"), "mine", MINE)


def grid(conf: Path, torque: list[float], errors: list[float], trials: int) -> Sweep:
    """The sweep, with other values."""
    values = [f"sweep.axes.torque.values={torque}", f"sweep.axes.error.values={errors}"]
    return expand(["+sweep=mine", f"sweep.trials={trials}", *values], conf)


def identities(sweep: Sweep) -> dict[tuple[tuple[str, ...], int], tuple[int, str]]:
    return {(trial.cell.labels, trial.repetition): (trial.seed, trial.hash) for trial in sweep.trials}


@pytest.mark.slow
@settings(max_examples=3, deadline=None)
@given(axis_values, axis_values, st.integers(1, 4), st.randoms())
def test_what_is_added_or_reordered_changes_no_other_trial(
    conf: Path, torque: list[float], errors: list[float], trials: int, rng: random.Random
) -> None:
    sweep = grid(conf, torque, errors, trials)
    before = identities(sweep)
    assert len(sweep.trials) == len(before) == len(torque) * len(errors) * trials
    assert len({seed for seed, _ in before.values()}) == len(before)
    assert len({identity for _, identity in before.values()}) == len(before)
    more = [*torque, *(value for value in VALUES if value not in torque)]
    after = identities(grid(conf, rng.sample(more, len(more)), errors[::-1], trials + 1))
    assert before.items() <= after.items()


@pytest.mark.slow
def test_what_counts_in_a_test_episode_is_said_as_the_tasks_of_all_cells_have_it() -> None:
    """Success of the task's own; where it has none, lasting."""
    points = {"balance": "{preset: cartpole}", "swing up": "{preset: acrobot_swingup}"}

    def said(*names: str) -> str:
        named = ", ".join(f"{name}: {points[name]}" for name in names)
        return expand([f"+sweep={{trials: 1, axes: {{robot: {{points: {{{named}}}}}}}}}"]).success

    assert said("swing up") == "succeeds"
    lasts = "lasts for the task's horizon without a failure"  # long episodes are not asked for their end
    assert said("balance") == lasts
    assert said("balance", "swing up") == f"succeeds ({lasts}, if its task has no success of its own)"


@pytest.mark.slow
def test_table_2() -> None:
    sweep = expand(["+sweep=table2"])
    assert (len(sweep.cells), len(sweep.trials)) == (24, 240)
    assert sweep.report.paper.keys() == {cell.labels for cell in sweep.cells}
    last = sweep.cells[-1]
    hardware = last.composition.config["hardware"]
    assert list(hardware["noise"].values()) == [0.1, 1.28e-4, 0.128]  # torque, angle, velocity
    assert hardware["inertia_error"] == 0.2
    assert sweep.report.paper[last.labels] == 3.6
    assert [trial.cell for trial in sweep.trials[:24]] == list(sweep.cells)  # first of each cell first
    fewer = ["sweep.axes.error.values=[0.1]", "sweep.axes.error.labels=[10% error]"]
    sweep = expand(["+sweep=table2", "sweep.trials=2", "bias=none", *fewer])
    assert (len(sweep.cells), len(sweep.trials)) == (12, 24)
    assert all(cell.composition.choices["bias"] == "none" for cell in sweep.cells)


@pytest.mark.slow
def test_identity_knows_neither_jobs_nor_store_nor_number_of_trials() -> None:
    one = expand(["+sweep=smoke"])
    other = expand(["+sweep=smoke", "sweep.trials=3", "engine=sequential", "tracking=none"])
    assert one.hash == other.hash
    assert identities(one).items() <= identities(other).items()
    assert expand(["+sweep=smoke", "bias.d=2"]).hash != one.hash
    assert expand(["+sweep=smoke", "sweep.axes={hardware.inertia_error: [0.1]}"]).hash == one.hash
    assert not identities(one).items() & identities(expand(["+sweep=smoke", "seed=1"])).items()


@pytest.mark.slow
def test_other_axes_or_seeds_are_another_sweep() -> None:
    keyed = [f"x: {{keys: {key}, values: [2.0]}}" for key in ("bias.d", "hardware.inertia_error")]
    axes = ["bias: [none]", "bias.d: [2.0]", *keyed]
    grids = [[f"+sweep.axes={{{axis}}}", "+sweep.trials=1"] for axis in axes]
    grids += [[*grids[0], "+sweep.common_seeds=[bias]"]]
    assert len({expand(overrides).hash for overrides in grids}) == 5


@pytest.mark.slow
def test_a_point_that_sets_another_key_leaves_the_sweep_what_it_is() -> None:
    sweep = ["+sweep.trials=1", "+sweep.axes={method: {points: {LQR: {method: lqr}}}}"]
    point = "+sweep.axes.method.points.robust={method: lqr, bias: none}"
    assert expand([*sweep, point]).hash == expand(sweep).hash


@pytest.mark.slow
def test_bad_sweep() -> None:
    for message, overrides in {
        "sweep=unknown: no such option; sweep has ablation, ": ["+sweep=unknown"],
        "sweep.trials: must be greater than 0, got 0": ["+sweep=smoke", "sweep.trials=0"],
        "sweep.trialss: no such key; +sweep.trialss=... sets one that": ["+sweep=smoke", "sweep.trialss=1"],
        "sweep.trialss: no such key": ["+sweep=smoke", "+sweep.trialss=1"],
        "sweep.axes: must be a valid dictionary, got 3": ["+sweep=smoke", "sweep.axes=3"],
        "sweep.axes.nosuch.keys: nosuch: no such key": ["+sweep=smoke", "+sweep.axes.nosuch=[1]"],
        "noise.keys: hardware.noise.torque_variance: no such key; +hardware.noise.NAME_variance=... sets": [
            "+sweep=fig6", "preset=cartpole"
        ],
        "bias=nosuch: no such option": ["+sweep=smoke", "+sweep.axes.bias=[gp, nosuch]"],
        "sweep.axes.x: tracking does not change any trial's result": [
            "+sweep={trials: 1, axes: {x: {keys: tracking.uri, values: [a]}}}"
        ],
        "seed is set elsewhere: each trial has its own": ["+sweep={trials: 1, axes: {seed: [1, 2]}}"],
        "set elsewhere": ["+sweep={trials: 1, axes: {bias.d: [1.0], x: {keys: bias.d, values: [2.0]}}}"],
        "sweep.axes.hardware.gaps.slope: hardware.gaps.slope is set elsewhere: x": [
            "+sweep={trials: 1, axes: {x: {points: {a: {hardware.gaps: {}}}}, hardware.gaps.slope: [0.02]}}"
        ],
        "sweep.axes.x: hardware.gaps is set elsewhere: hardware.gaps.slope": [
            "+sweep={trials: 1, axes: {hardware.gaps.slope: [0.02], x: {points: {a: {hardware.gaps: {}}}}}}"
        ],
        "sweep.axes.x: hardware is a group; its values must be options, or write hardware.friction": [
            "+sweep={trials: 1, axes: {x: {points: {a: {hardware: {}}}}}}",
            "+sweep.axes.x.points.a.hardware.friction=0.5",
        ],
        "sweep.axes.x: hardware is a group; its values must be options, or write +hardware.gaps": [
            "+sweep={trials: 1, axes: {x: {points: {a: {+hardware: {gaps: {slope: 1}}}}}}}"
        ],
        "sweep.axes.bias.d: no such key; '+sweep.axes={bias.d: [...]}' sets or adds an axis": [
            "+sweep=smoke", "sweep.axes.bias.d=[1.0]"
        ],
        "sweep.axes.x.labels: no such key; +sweep.axes.x.labels=... sets one that": [
            "+sweep={trials: 1, axes: {x: {keys: bias.d, values: [1.0]}}}", "sweep.axes.x.labels=[a]"
        ],
        "adds an axis; an axis has keys, values, labels, points and only": [
            "+sweep={trials: 1, axes: {x: {keys: bias.d, values: [1.0]}}}", "sweep.axes.x.valus=[0.1]"
        ],
        "sweep.axes.y: no such axis; `only` keeps points of one that the sweep has": [
            "+sweep={trials: 1, axes: {x: {keys: bias.d, values: [1.0]}}}", "+sweep.axes.y.only=[1.0]"
        ],
        "sweep.axes.task.horizon: no such axis; `only` keeps": [
            "+sweep=smoke", "+sweep.axes.task.horizon.only=[1]"
        ],
        "sweep.axes.x.keys: hardware.nosuch: no such key": [
            "+sweep={trials: 1, axes: {x: {points: {a: {hardware.nosuch: {b: 1}}}}}}"
        ],
        "sweep.axes: no such key; '+sweep.axes={NAME: [...]}' sets or adds": [
            "+sweep=smoke", "sweep.axes={bias: [gp]}"
        ],
        "sweep.axes: 0 none and 0  none are the same": ["+sweep=smoke", "+sweep.axes.bias=[none, ' none']"],
        "sweep.report.columns: no such axis: no": ["+sweep=smoke", "+sweep.report.columns=no"],
        "sweep.common_seeds: no such axis: no; available: ": ["+sweep=smoke", "+sweep.common_seeds=[no]"],
        "sweep.axes.mean: is a column's name; choose another": [
            "+sweep=smoke", "+sweep.axes.mean={keys: bias.d, values: [1]}"
        ],
    }.items():  # fmt: skip
        with one_line(re.escape(message)):
            expand(overrides)


def test_bad_axis() -> None:
    for message, spec in {
        "has no keys": {"keys": [], "values": [[]]},
        "has no values": [],
        "has 2 labels for 1 values": {"keys": "x", "values": [0.1], "labels": ["a", "b"]},
        "names a key twice: x, +x": {"keys": ["x", "+x"], "values": [[1, 2]]},
        "must be a list of values, got 'gp'": "gp",
        "must be a list of values; for a key with dots: '+sweep.axes={bias.a.d: [...]}'": {
            "a": {"d": [1, 2]}
        },
        "must be a list of values, or have keys and values, or points": {"point": {"a": {"bias": "gp"}}},
        "has a name or label with unprintable characters": {
            "keys": "x", "values": ["gp"], "labels": ["a\tb"]
        },
        "has the same value or label twice: gp, gp": ["gp", "gp"],
        "each of its values must list 2, one for each key, got 0.1": {"keys": ["seed", "x"], "values": [0.1]},
    }.items():  # fmt: skip
        with one_line(rf"^sweep\.axes\.bias: {re.escape(message)}$"):
            read_axis("bias", spec)


def test_only_keeps_points_by_their_labels() -> None:
    points = {"points": {"a": {"bias": "none"}, "b": {"bias": "gp"}, "c": {"seed": 3}}}
    axis = read_axis("x", points | {"only": ["c", "a"]})
    kept = [(point.label, point.values) for point in axis.points]
    assert kept == [("a", {"bias": "none"}), ("c", {"seed": 3})]  # in the axis' order
    assert read_axis("x", points | {"only": None}) == read_axis("x", points)
    noise = {"keys": ["u", "v"], "values": [[0.0, 0.5], [1.0, 2.0]]}
    one = read_axis("x", noise | {"only": ["1/2"]})
    assert one == replace(read_axis("x", noise | {"values": [[1.0, 2.0]]}), left_out=("0/0.5",))
    single = {"keys": "u", "values": [0.25, 0.5]}
    assert read_axis("x", single | {"only": [0.5]}).labels == ("0.5",)
    other = {"keys": "u", "values": [True, None, 1.0], "only": [True, None]}
    assert read_axis("x", other).labels == ("True", "None")
    assert read_axis("x", other | {"labels": ["on", "off", "1.0"], "only": ["off", 1.0]}).labels == (
        "off",
        "1.0",
    )
    for only, message in (
        (["d"], "x.only: no such point: d; there are a, b, c"),
        ([], "x.only: keeps no point"),
    ):
        with one_line(re.escape(f"sweep.axes.{message}")):
            read_axis("x", points | {"only": only})


@pytest.mark.slow
def test_some_points_of_a_sweep_are_some_of_its_trials() -> None:
    whole = ["+sweep={trials: 2, axes: {x: {points: {a: {bias: none}, b: {bias: gp}}}}}"]
    one, all_of_them = expand([*whole, "+sweep.axes.x.only=[b]"]), expand(whole)
    assert one.hash == all_of_them.hash
    assert (len(one.trials), len(all_of_them.trials)) == (2, 4)
    assert identities(one).items() <= identities(all_of_them).items()


def test_points_need_not_set_the_same_keys() -> None:
    axis = read_axis("cell", {"points": {"a": {"bias": "none"}, "b": {"seed": 3, "+hardware.x": 1}}})
    assert axis.keys == ("bias", "seed", "hardware.x")
    assert axis.labels == ("a", "b")
    for points, message in (({"a": 1}, r"cell\.points\.a: "), ({}, "cell: has no values")):
        with pytest.raises(ConfigError, match=rf"^sweep\.axes\.{message}"):
            read_axis("cell", {"points": points})


@pytest.mark.slow
def test_an_axis_may_add_a_key() -> None:
    """So the paper's figures are had of robots whose quantities have other names."""
    noise = "sweep.axes.noise.keys=+hardware.noise.force_variance"
    sweep = expand(["+sweep=fig6", "preset=cartpole", noise])
    assert [cell.composition.config["hardware"]["noise"] for cell in sweep.cells] == [
        {"force_variance": 0.0},
        {"force_variance": 0.1},
    ]
    alone = compose(["preset=cartpole", "bias=sparse_gp", "+hardware.noise.force_variance=0.1"])
    assert sweep.cells[1].composition.group_hash == alone.trial.group_hash
    assert sweep.axes[0].keys == ("hardware.noise.force_variance",)


@pytest.mark.slow
def test_the_sweep_that_the_docs_show_is_one(tmp_path: Path) -> None:
    text = (ROOT / "conf" / "README.md").read_text()
    (shown,) = re.findall(r"^```yaml\n(defaults:.*?)^```", text, re.MULTILINE | re.DOTALL)
    sweep = expand(["+sweep=mine"], write_sweep(tmp_path, "mine", shown))
    assert [axis.labels for axis in sweep.axes] == [
        ("0", "0.2"), ("no noise", "all noise"), ("nothing", "residual")
    ]  # fmt: skip
    assert (len(sweep.trials), len({trial.seed for trial in sweep.trials})) == (80, 40)
    last = sweep.cells[-1].composition
    assert (last.choices["evaluation"], last.config["bias"]["d"]) == ("domain_randomization", 2.0)
    assert "experiments" in sweep.figures


@pytest.mark.slow
def test_a_dry_run_needs_no_plus(conf: Path) -> None:
    """Whether the sweep's file names it or not; nor may it have one only where the file leaves it out."""
    values = [f"sweep.axes.{axis}.values=[0.1]" for axis in ("torque", "error")]
    for dry in ([], ["sweep.dry_run=true"], ["+sweep.dry_run=true"]):
        assert expand(["+sweep=mine", *values, *dry], conf).dry_run == bool(dry)


def test_shipped_sweeps_are_the_files() -> None:
    assert sweeps() == sorted(file.stem for file in (ROOT / "sweeps").glob("*.yaml"))
