"""The study of public rigs, as a command, on a simulated pendulum in their place; and its baselines."""

import runpy
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from models import with_values
from pendulum import pendulum
from recordings import choices

from simbias.core import Nominal
from simbias.core.parameters import values_at
from simbias.core.records import Array, Rollout
from simbias.learning.bias.none import ConstantBias
from simbias.learning.identification.identified import Identified
from simbias.learning.identification.rig import Motor
from simbias.learning.identification.rig import Rig as LearnedRig
from simbias.recordings import horizons
from simbias.simulation.open_loop import plain

pytestmark = pytest.mark.slow

STUDY = ROOT / "sweeps" / "studies" / "rigs"
ZEROS = (0.06, -0.04, 0.0)  # rad, of the encoder in each recording
FRAMES = 150  # of 5 ms
QUICK = [
    *("identification.starts=1", "identification.rounds=1"),
    *("identification.evaluations=2", "identification.longer_windows=[]"),
]


def simulated(robot: Nominal, x: Array, u: Array, push: Array | float = 0.0) -> Array:
    """The states (k+1, ...) from x on, under the inputs (k, ...), pushed after each frame."""
    states = [x]
    for each in u:
        states.append(robot.step(states[-1], each) + push)
    return np.array(states)


@pytest.fixture(autouse=True)
def modules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(STUDY)


def quick() -> dict[str, Any]:
    """What is declared of the simple pendulum, identified in few steps."""
    from loading import declared

    rig = declared()["simple_pendulum"]
    return rig | {"composition": [*rig["composition"], *QUICK]}


def loaded(declaration: dict[str, Any]) -> Any:
    """A rig without its recordings."""
    from loading import load

    return load(declaration | {"development": []}, ROOT)


def recordings(zeros: Sequence[float]) -> Iterator[pd.DataFrame]:
    """Of a pendulum that is not quite the described one, as its lab would have written them."""
    prior = loaded(quick()).prior
    robot = with_values(prior, **{"hinge.friction": 0.2, "hinge.damping": 0.05, "hinge.gain": 0.8})
    rng, t, k = np.random.default_rng(0), 0.005 * np.arange(FRAMES)[:, None], len(zeros)
    u = sum(
        rng.uniform(0.5, 1.5, k) * np.sin(rng.uniform(2, 12, k) * t + rng.uniform(0, 6, k)) for _ in range(4)
    )
    x = simulated(robot, np.zeros((k, 2)), u[:, :, None])[:-1]
    noisy = x + np.array([2e-4, 0.02]) * rng.standard_normal((FRAMES, k, 2))
    for i, zero in enumerate(zeros):
        columns = {"position": noisy[:, i, 0] + zero, "velocity": noisy[:, i, 1], "torque": u[:, i]}
        yield pd.DataFrame({"time": t[:, 0], **columns})


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., pd.DataFrame]:
    """Runs the study on simulated recordings of the simple pendulum; those of the test have no zeros."""
    import loading

    rig = quick()
    monkeypatch.setattr(loading, "declared", lambda: {"simple_pendulum": rig})
    monkeypatch.setattr(horizons, "HORIZONS", (0.1,))
    zeros = dict.fromkeys(rig["test"], 0.0) | dict(zip(rig["development"], ZEROS, strict=True))
    for name, made in zip(zeros, recordings(list(zeros.values())), strict=True):
        file = tmp_path / "torque_limited_simple_pendulum" / rig["folder"] / name
        file.parent.mkdir(parents=True)
        made.to_csv(file, index=False)
    monkeypatch.chdir(tmp_path)

    def run_study(*arguments: str) -> pd.DataFrame:
        monkeypatch.setattr(sys, "argv", ["rigs", ".", "--rigs", "simple_pendulum", *arguments])
        runpy.run_path(str(STUDY), run_name="__main__")
        return pd.read_csv("rigs.csv")

    return run_study


def test_the_study_learns_from_one_and_from_several(study: Callable[..., pd.DataFrame]) -> None:
    """What is identified beats the described model, and more so with the zeros of what is predicted."""
    found = study("--ways", "nominal", "lab", "identified")
    assert (found.groupby(["number", "way"])["learned"].nunique() == 3).all()  # test recordings are no cases
    ratios = found.groupby(["number", "way"])["ratio"].mean()
    assert ratios["one", "lab"] == ratios["several", "lab"] == 1.0
    assert ratios["one", "identified"] < 0.7 * ratios["one", "nominal"]
    assert ratios["one", "identified and zeros"] < ratios["one", "identified"]
    assert "| simple_pendulum | 0.1 s |" in Path("table.md").read_text()


def test_at_the_end_test_recordings_are_predicted(study: Callable[..., pd.DataFrame]) -> None:
    """By what each development recording tells, and by what all of them tell."""
    found = study("--test", "--ways", "lab")
    assert found.groupby("number")["learned"].nunique().to_dict() == {"one": 3, "several": 1}
    assert (found["ratio"] == 1.0).all()


def test_recordings_that_are_learned_from_are_counted() -> None:
    """Of four, where five are asked for, all are learned from."""
    counts = [(count, len(names)) for _, count, names in choices([f"excitation_{i}" for i in range(4)])]
    assert counts[-1] == (4, 4)
    assert all(count == number for count, number in counts)
    table = pd.read_csv(ROOT / "sweeps" / "results" / "recordings" / "recordings.csv")
    assert (table["learned"].str.split().str.len() == table["count"]).all()


def test_errors_are_told_as_published_ones_are() -> None:
    """Of a state, after a while or in a simulation of whole recordings; zero for the model that made them."""
    from in_units import rows

    rig = loaded(quick())
    u = np.sin(0.05 * np.arange(200))[:, None]
    states = simulated(rig.study.nominal, np.zeros(2), u)
    made = Rollout(states, u, measured=states, sensed=True)
    rig = rig._replace(development={"a": made, "b": made})
    for when in ({}, {"seconds": 0.2}):
        found = pd.DataFrame(rows(rig, {"state": "angle", "error": 0.1} | when))
        error = found.groupby("way")["rmse"].max()
        assert error["nominal"] < 1e-9
        assert error["identified"] < 0.3 * error["lab"]
        assert found["parameters"].str.contains("rod.mass").sum() == 2


def test_mujocos_own_identification_finds_a_double_pendulum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of its own file: what has friction and another mass predicts better than the described model."""
    import mujoco_sysid
    from loading import declared
    from ways import nominal, sysid

    monkeypatch.setattr(horizons, "predict", plain)  # each model once
    monkeypatch.setattr(mujoco_sysid, "STEPS", 3)
    rig = loaded(declared()["design_C.1"])
    robot = with_values(rig.prior, friction_1=0.1, friction_2=0.1, mass_2=0.7)
    rng, t = np.random.default_rng(0), 0.002 * np.arange(200)[:, None]
    u = sum(rng.uniform(0.5, 1.0, 2) * np.sin(rng.uniform(3, 20, 2) * t) for _ in range(4))
    rollout = Rollout(simulated(robot, np.zeros(4), u), u)
    before, after = (np.abs(way(rig, [rollout]).errors([rollout], 50)).mean() for way in (nominal, sysid))
    assert after < 0.3 * before


def test_a_residual_that_hurts_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one recording its thirds tell, of several each other one; a residual that helps stays."""
    import ways

    rig = loaded(quick())
    u = np.sin(0.05 * np.arange(400))[:, None]
    rollout = Rollout(simulated(rig.study.nominal, np.zeros(2), u, np.array([0.0, 0.01])), u)

    def pushed(by: float, count: int) -> ways.Learned:
        bias = ConstantBias(np.array([0.0, by]), np.zeros(2))

        def learned(_: object, rollouts: Sequence[Rollout]) -> ways.Learned:
            return ways.Learned(rig.study.nominal, [rig.study.nominal] * len(rollouts), bias)

        monkeypatch.setattr(ways, "with_residual", learned)
        return ways.guarded(rig, [rollout] * count)

    for count in (1, 2):
        assert pushed(0.01, count).bias is not None
        assert pushed(-0.01, count).bias is None


def test_the_labs_parameters_are_within_the_priors() -> None:
    """Each rig can be composed without its recordings, and coordinates give the lab's values back."""
    from loading import declared
    from ways import of_lab

    for name, declaration in declared().items():
        rig = loaded(declaration)
        known = of_lab(rig)
        made = dict(zip(known.parameters, values_at(rig.prior.parameters, np.array(known.mode)), strict=True))
        labs = {parameter.name: parameter.value for parameter in rig.prior.parameters} | rig.lab_values
        assert made == pytest.approx(labs, rel=1e-6, abs=1e-12), name


def test_recordings_differ_by_their_own_and_a_little_by_all_else() -> None:
    from ways import SHIFT, of_shared, of_shift

    study = pendulum()
    rig = LearnedRig(study.task, study.nominal, {"tau1": Motor(offset=0.2, zero=0.1)}, {})
    p, names = len(rig.parameters), [each.name for each in rig.parameters]
    model = Identified(rig, np.zeros(p), 0.5 * np.eye(p), {})
    for other, own, else_ in (of_shift(model), 1.0, SHIFT), (of_shared(model), 0.0, 0.5):
        deviations = dict(zip(names, np.sqrt(np.diag(other.covariance)), strict=True))
        assert deviations.pop("tau1.zero") == own
        assert set(deviations.values()) == {else_}
