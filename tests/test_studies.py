"""The studies that try policies, run as commands, shortened."""

import runpy
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import joblib
import numpy as np
import pandas as pd
import premise
import pytest
from conftest import ROOT
from identify_coverage import Case, measure
from sweeping import FOLDERS, NO_FIGURES

from simbias.__main__ import main

pytestmark = pytest.mark.slow

STARTS = 3  # from which policies are tried
Study = Callable[..., str]


@pytest.fixture
def study(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Study:
    """Runs a study in this process, without workers of its own, and returns what it prints."""

    monkeypatch.setattr(premise, "STARTS", STARTS)
    monkeypatch.setattr(premise, "balanced_starts", partial(premise.balanced_starts, starts=STARTS))

    def run_study(name: str, *arguments: str) -> str:
        program = str(ROOT / "sweeps" / "studies" / f"{name}.py")
        capsys.readouterr()
        monkeypatch.setattr(sys, "argv", [program, *arguments])
        with joblib.parallel_config("sequential"):
            runpy.run_path(program, run_name="__main__")
        return capsys.readouterr().out

    return run_study


def test_last_policies_of_a_sweep_are_tried(study: Study, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"^trials: no finished trial of smoke, 0$"):
        study("last_policies", "smoke", "policies.csv")
    assert main(["+sweep=smoke", NO_FIGURES, *FOLDERS, "engine=sequential"]) == 0
    head, _, *body = study("last_policies", "smoke", "policies.csv").splitlines()
    assert head.endswith("| succeeded | starts that the last policy balances |")
    assert [line.split(" | ")[0] for line in body] == ["| 0", "| 0.2"]
    found = pd.read_csv(tmp_path / "policies.csv")
    assert list(found["repetition"]) == [0, 0, 1, 1]
    assert found["balanced"].between(0, STARTS).all()
    assert set(found["starts"]) == {STARTS}


def test_a_policy_is_searched_on_the_hardware(study: Study, tmp_path: Path) -> None:
    short = ["--seeds", "1", "--evaluations", "3", "task.horizon=60", "optimizer.max_evaluations=20"]
    study("searched_on_hardware", "found.csv", *short)
    (found,) = pd.read_csv(tmp_path / "found.csv").to_dict("records")
    assert (found["seed"], found["starts"]) == (0, STARTS)
    assert found["hardware_balances"] == found["simulated_balances"] == STARTS  # nobody falls within 60 ms


def few_gaps(values: list[str], labels: list[str]) -> list[str]:
    """Overrides that leave these cells of `+sweep=gaps`."""
    listed = ", ".join(f"[{{{value}}}]" for value in values)
    quoted = ", ".join(f"'{label}'" for label in labels)
    return [f"sweep.axes.gap.values=[{listed}]", f"sweep.axes.gap.labels=[{quoted}]"]


@pytest.mark.usefixtures("uncompiled")
def test_policies_are_searched_on_the_hardware_of_a_sweeps_cell(study: Study, tmp_path: Path) -> None:
    short = ["--seeds", "1", "--evaluations", "2", "task.horizon=20", "optimizer.max_evaluations=5"]
    nearby = ["--sweep", "gaps", "--cells", "motor 60", "--screening", "2", "--deviation", "0.002"]
    quick = ["method.max_iterations=1", "method.lqr_candidates=0", "evaluation.seconds=0.02"]
    quick += ["identification=none", "bias=none"]
    gaps = few_gaps(["slope: 0.02", "motor_gain: 0.6"], ["slope", "motor 60%"])
    study("searched_on_hardware", "found.csv", *short, *nearby, *quick, *gaps)
    assert list(pd.read_csv(tmp_path / "found.csv")["cell"]) == ["motor 60%"]


@pytest.mark.usefixtures("uncompiled")
def test_robots_are_tried_by_each_way(study: Study, tmp_path: Path) -> None:
    ways = ["--ways", "preset", "lqr", "bayesian"]
    short = ["--seeds", "1", "--experiments", "3", "--test", "0.5"]
    short += ["--set", "optimizer.max_evaluations=5", "task.horizon=20"]
    study("robots", "robots.csv", "cartpole", *ways, *short)
    tried = pd.read_csv(tmp_path / "robots.csv")
    assert list(tried["way"]) == ways[1:]
    assert tried["test_successes"].between(0, 20).all()
    made = tried.set_index("way")["experiments"]
    assert made["lqr"] == 2
    assert 1 <= made["bayesian"] <= 4


def test_what_is_learned_on_one_engine_is_tried_on_all(study: Study, tmp_path: Path) -> None:
    short = ["--seeds", "1", "task.horizon=60", "optimizer.max_evaluations=20", "evaluation=nominal_start"]
    printed = study("engines", "engines.csv", *short)
    tried = pd.read_csv(tmp_path / "engines.csv")
    engines = ["pymunk", "box2d", "mujoco_bongoboard"]
    assert list(tried["learned on"]) == engines
    assert (tried[engines] == STARTS).all(axis=None)  # nobody falls within 60 ms
    assert [line.split(" | ")[0] for line in printed.splitlines()[2:]] == [f"| {name}" for name in engines]


@pytest.mark.usefixtures("plain_predictions")
def test_what_is_learned_of_gaps_predicts_other_experiments(study: Study, tmp_path: Path) -> None:
    """A motor of 40% is a parameter of the model: what is identified predicts best."""
    quick = ["identification.starts=2", "identification.rounds=1", "identification.evaluations=3"]
    known = ("slope", "ankle_damping", "ankle_stiffness", "ankle_friction", "payload_mass", "payload_x")
    known += ("masses", "foot_mass", "torque_offset", "lag", "delay")
    quick += [f"nominal.uncertainty.{name}=0" for name in known]
    gaps = few_gaps(["motor_gain: 0.4"], ["motor 40%"])
    arguments = ["--cells", "motor 40", "--seeds", "1", "task.horizon=300", "nominal.sampled=null", *quick]
    printed = study("gaps_predicted", "predicted.csv", *arguments, *gaps)
    assert printed.splitlines()[-1].startswith("| motor 40% | ")
    errors = pd.read_csv(tmp_path / "predicted.csv").set_index("way")["error"]
    assert errors["nominal"] == 1
    assert errors["identified"] < 0.3
    assert errors["both"] < 0.3


def test_intervals_of_a_drawn_robot_are_counted() -> None:
    """A spring that the model lacks is noticed, and no parameter is trusted."""
    inputs = [np.sin(np.arange(400)[:, None] * np.array(rates)) for rates in ([0.05, 0.08], [0.09, 0.04])]
    found, lacking = (measure(Case("two-link arm", 100, spring=s), 0, inputs) for s in ("no", "yes"))
    assert found["over_explained"] < 2 < lacking["over_explained"]
    assert found["intervals"] == 11
    assert 0 < found["trusted_hold"] <= found["hold"] <= 11
    assert lacking["trusted"] == lacking["trusted_hold"] == 0


def test_planners_solve_the_same_problem(study: Study, tmp_path: Path) -> None:
    """Once with formulas, once with an engine: IPOPT's plan is one of the model, and costs about as much."""
    short = ["--draws", "1", "--experiments", "0", "--set", "task.horizon=60"]
    printed = study("planners", str(tmp_path), "--presets", "cartpole_trajectory", "pendulum_swingup", *short)
    assert len(printed.splitlines()) == 2 + 2 * 3
    plans = pd.read_csv(tmp_path / "planners.csv")
    solved = plans[plans["planner"] == "IPOPT"]
    assert set(solved["status"]) == {"Solve_Succeeded"}
    assert solved["defect"].max() < 1e-5
    assert solved["input_share"].max() < 0.8 + 1e-6
    best = plans.groupby(["preset", "model", "planner"])["cost"].min().unstack()
    np.testing.assert_allclose(best["IPOPT"], best["patient iLQR"], rtol=0.01)
