"""Trials that a real SQLite store holds, read back, are the trials that ran."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from sweeping import QUICK, runs

import simbias
from simbias.__main__ import main
from simbias.config import ConfigError
from simbias.records import Iteration
from simbias.study import Study, Unobserved
from simbias.sweep.grid import expand
from simbias.tracking.store import connect
from simbias.tracking.trials import load_trial
from simbias.trial import run_trial
from simbias.worker import run_plan

SHORT = [
    "task.horizon=1000",
    "optimizer.max_evaluations=30",
    "method.max_iterations=3",
    "cost.max_cost=1e-3",  # never reached
    "tracking.pictures=false",
]
SENSED = ["hardware.noise.angle_variance=1e-6", "hardware.record=measured"]
FEW = ["optimizer.max_evaluations=40", "method.max_iterations=3"]


@pytest.fixture(scope="module")
def uri(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A store that holds the trials of this module."""
    address = f"sqlite:///{tmp_path_factory.mktemp('store')}/mlflow.db"
    connect(address, "simbias")
    return address


def keep(study: Study) -> tuple[str, list[Iteration]]:
    """Run a trial into the store; its run and its records in memory."""
    tracked, iterations = study.tracking.open(study), []
    run_trial(study, tracked, Unobserved(), iterations.append)
    return tracked.run_id, iterations  # type: ignore[attr-defined]


def assert_equal(read: Any, ran: Any, where: str = "") -> None:
    """Two records are the same, to the last bit."""
    if isinstance(ran, np.ndarray):
        np.testing.assert_array_equal(read, ran, err_msg=where)
    elif is_dataclass(ran):
        assert type(read) is type(ran)
        for field in fields(ran):
            if field.name != "fitted_bias":
                assert_equal(getattr(read, field.name), getattr(ran, field.name), f"{where}.{field.name}")
    elif isinstance(ran, tuple):
        for index, (a, b) in enumerate(zip(read, ran, strict=True)):
            assert_equal(a, b, f"{where}[{index}]")
    else:
        assert read == ran, where


def assert_same_predictions(study: Study, read: Sequence[Iteration], ran: Sequence[Iteration]) -> None:
    """The fitted biases say the same everywhere, near their data and far from it."""
    width = len(study.task.states) + len(study.task.inputs)
    inputs = np.random.default_rng(0).normal(0.0, 0.5, (20, width))
    for a, b in zip(read, ran, strict=True):
        got, expected = (iteration.fitted_bias.predict(inputs) for iteration in (a, b))
        np.testing.assert_array_equal(got[0], expected[0])
        np.testing.assert_array_equal(got[1], expected[1])


@pytest.mark.parametrize(
    "overrides",
    [
        pytest.param(SHORT, id="gp"),
        pytest.param([*SHORT, "bias=sparse_gp", *SENSED], id="sparse gp, measured states"),
        pytest.param([*POINT_MASS, *FEW, "--config-dir"], id="own components"),
    ],
)
def test_a_trial_is_read_back_as_it_ran(overrides: list[str], uri: str) -> None:
    config_dir = OWN_CONF if "--config-dir" in overrides else None
    words = [word for word in overrides if word != "--config-dir"]
    study = simbias.load([*words, f"tracking.uri={uri}"], config_dir)
    run_id, ran = keep(study)
    assert len(ran[-2].data) > 0  # from which a bias was learned
    trial = load_trial(run_id, uri)
    assert_equal(trial.iterations, tuple(ran))
    assert_same_predictions(study, trial.iterations, ran)
    assert (trial.run_id, trial.study.hash, trial.study.title) == (run_id, study.hash, study.title)
    assert trial.study.choices == {**study.choices, "tracking": "none"}


def test_trials_of_a_sweep_are_read_back(tmp_path: Path) -> None:
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    words = ["+sweep=smoke", *QUICK, "sweep.trials=1", "engine=sequential"]
    assert main([*words, f"tracking.uri={uri}"]) == 0
    (parent,), trials = runs(tmp_path)
    planned = {trial.hash: trial for trial in expand(words).trials}
    assert len(trials) == len(planned) == 2
    for run in trials:
        composition = planned[run.data.tags["hash"]].composition
        trial, record = load_trial(run.info.run_id, uri), run_plan((composition.config, composition.choices))
        assert [i.seconds.keys() for i in trial.iterations] == [i.seconds.keys() for i in record.iterations]
        for read, ran in zip(trial.iterations, record.iterations, strict=True):
            for name in ("optimum", "experiments", "selection", "data", "total_experiments", "succeeded"):
                assert_equal(getattr(read, name), getattr(ran, name), name)
    with pytest.raises(ConfigError, match=f"{parent.info.run_id}: is a sweep"):
        load_trial(parent.info.run_id, uri)


def test_an_iteration_that_did_not_end_is_not_read(uri: str) -> None:
    study = simbias.load([*SHORT, "seed=1", f"tracking.uri={uri}"])
    tracked = study.tracking.open(study)
    first = next(study.run())
    for index, rollout in enumerate(first.experiments):
        tracked.experimented(0, index, first.optimum.parameters, rollout)
    run_id = tracked.run_id  # type: ignore[attr-defined]
    assert load_trial(run_id, uri).iterations == ()
    tracked.log(first)
    tracked.experimented(1, 0, first.optimum.parameters, first.experiments[0])
    assert_equal(load_trial(run_id, uri).iterations, (first,))


def test_what_is_no_trial_is_one_line(uri: str, tmp_path: Path) -> None:
    client, experiment_id = connect(uri, "another")
    foreign = client.create_run(experiment_id).info.run_id
    lost = client.create_run(experiment_id, tags={"hash": "abc"}).info.run_id
    for run_id, message in {
        "0" * 32: "no such run in sqlite:",
        foreign: "is no run of simbias",
        lost: "its files cannot be read",
    }.items():
        with pytest.raises(ConfigError, match=f"^{run_id}: {message}") as caught:
            load_trial(run_id, uri)
        assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"^tracking\.uri: .*no such store"):
        load_trial(foreign, f"sqlite:///{tmp_path}/none.db")
    assert not list(tmp_path.iterdir())


def test_a_missing_file_is_named(uri: str) -> None:
    study = simbias.load([*SHORT, "method.max_iterations=1", f"tracking.uri={uri}"])
    run_id, _ = keep(study)
    client, _ = connect(uri, "simbias")
    folder = Path(client.get_run(run_id).info.artifact_uri.removeprefix("file://"))
    (folder / "data" / "iteration_00.npz").unlink()
    with pytest.raises(ConfigError, match=f"{run_id}: .*iteration_00.npz"):
        load_trial(run_id, uri)
