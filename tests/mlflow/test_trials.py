"""Trials that a real SQLite store holds, read back, are the trials that ran."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from records import assert_equal, timeless
from sweeping import NO_FIGURES, QUICK, runs

import simbias
from simbias.config import ConfigError, Variations
from simbias.core.records import Array, Iteration, Learning, Rollout
from simbias.engine.sequential import Sequential
from simbias.mlflow.store import connect
from simbias.mlflow.tracking import Mlflow
from simbias.mlflow.trials import load_trial
from simbias.sweep.running import prepare, run_sweep
from simbias.sweep.worker import Plan, run_plan
from simbias.trial.run import Outcome, TrialRecord, run_trial
from simbias.trial.study import Observer, Study

pytestmark = pytest.mark.slow

SHORT = [
    "task.horizon=1000",
    "optimizer.max_evaluations=30",
    "method.max_iterations=3",
    "cost.max_cost=1e-3",  # never reached
]
SENSED = ["hardware.noise.angle_variance=1e-6", "hardware.record=measured"]
FEW = ["optimizer.max_evaluations=40", "method.max_iterations=3"]


@pytest.fixture(scope="module")
def uri(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A store that holds the trials of this module."""
    address = f"sqlite:///{tmp_path_factory.mktemp('store')}/mlflow.db"
    connect(address, "simbias")
    return address


def keep(study: Study, uri: str) -> tuple[str, TrialRecord]:
    """Run a trial into the store; its run and its record in memory."""
    tracked = Mlflow(uri, pictures=False).open(study)
    record = run_trial(study, tracked)
    return tracked.run_id, record  # type: ignore[attr-defined]


def predictions(iteration: Iteration, inputs: Array) -> tuple[Array, Array]:
    """Those of the fitted bias that the iteration's search was made on."""
    assert iteration.search is not None
    assert iteration.search.fitted_bias is not None
    return iteration.search.fitted_bias.predict(inputs)


def learned(iteration: Iteration) -> Learning:
    """What the iteration learned."""
    assert iteration.learning is not None
    return iteration.learning


def assert_same_predictions(study: Study, read: Sequence[Iteration], ran: Sequence[Iteration]) -> None:
    """The fitted biases say the same everywhere, near their data and far from it."""
    width = len(study.task.states) + len(study.task.inputs)
    inputs = np.random.default_rng(0).normal(0.0, 0.5, (20, width))
    for a, b in zip(read, ran, strict=True):
        got, expected = (predictions(iteration, inputs) for iteration in (a, b))
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
    study = simbias.load(words, config_dir)
    run_id, record = keep(study, uri)
    ran = record.iterations
    assert len(learned(ran[-2]).data) > 0  # from which a bias was learned
    trial = load_trial(run_id, uri, config_dir)
    assert_equal(trial.iterations, ran)
    assert_same_predictions(study, trial.iterations, ran)
    assert (trial.run_id, trial.study.hash, trial.study.title) == (run_id, study.hash, study.title)
    assert trial.study.choices == {**study.choices, "tracking": "none"}


def test_a_trial_that_went_on_is_read_back_as_one_that_was_not_disturbed(uri: str) -> None:
    study = simbias.load([*SHORT, "seed=2"])

    class Stopping(Observer):
        def __init__(self, after: int) -> None:
            self.left = after

        def experimented(self, rollout: Rollout) -> None:
            self.left -= 1
            if not self.left:
                raise KeyboardInterrupt

    for after in (1, 3, 6):
        tracked = Mlflow(uri, pictures=False).open(study)
        with pytest.raises(KeyboardInterrupt):
            run_trial(study, tracked, Stopping(after))
        run_id = tracked.run_id  # type: ignore[attr-defined]
        read = load_trial(run_id, uri)
        assert len(read.iterations) == (after - 1) // 2
    again, record = keep(study, uri)
    assert again == run_id
    undisturbed = run_trial(study)
    assert_equal(timeless(record), timeless(undisturbed))
    trial = load_trial(run_id, uri)
    assert_equal(
        timeless(replace(record, iterations=trial.iterations)), timeless(undisturbed), "as it is read back"
    )
    assert_same_predictions(study, trial.iterations, undisturbed.iterations)
    finished = Mlflow(uri).open(study).finished()
    assert finished is not None
    assert_equal(finished.iterations, trial.iterations)


def test_trials_of_a_sweep_are_read_back(tmp_path: Path) -> None:
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    words = ["+sweep=smoke", NO_FIGURES, *QUICK, "sweep.trials=1"]
    store = Mlflow(uri, pictures=False)
    sweep, _, _ = prepare(store, Variations(words))
    run_sweep(sweep, Sequential(), store.open_sweep(sweep, "the command"))
    (parent,), trials = runs(tmp_path)
    planned = {trial.hash: trial for trial in sweep.trials}
    assert len(trials) == len(planned) == 2
    for run in trials:
        composition = planned[run.data.tags["hash"]].composition
        trial = load_trial(run.info.run_id, uri)
        record = run_plan(Plan(composition.config, composition.choices))
        assert [i.seconds.keys() for i in trial.iterations] == [i.seconds.keys() for i in record.iterations]
        assert_equal(timeless(replace(record, iterations=trial.iterations)), timeless(record))
    with pytest.raises(ConfigError, match=f"{parent.info.run_id}: is a sweep"):
        load_trial(parent.info.run_id, uri)


def test_an_iteration_that_did_not_end_is_not_read(uri: str) -> None:
    study = simbias.load([*SHORT, "seed=1"])
    tracked = Mlflow(uri, pictures=False).open(study)
    first = next(study.run())
    run_id = tracked.run_id  # type: ignore[attr-defined]
    assert load_trial(run_id, uri).iterations == ()
    tracked.iterated(first)
    assert_equal(load_trial(run_id, uri).iterations, (first,))
    tracked.ended(TrialRecord(Outcome.INTERRUPTED, (first,), unfinished=first.experiments[:1]))
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
    study = simbias.load([*SHORT, "method.max_iterations=1"])
    run_id, _ = keep(study, uri)
    client, _ = connect(uri, "simbias")
    folder = Path(client.get_run(run_id).info.artifact_uri.removeprefix("file://"))
    names = (
        "data/iteration_00.npz",
        "policies/iteration_00.json",
        "experiments/iteration_00_experiment_1.npz",
    )
    for name in names:
        content = (folder / name).read_bytes()
        (folder / name).unlink()
        with pytest.raises(ConfigError, match=f"{run_id}: .*{Path(name).name}"):
            load_trial(run_id, uri)
        (folder / name).write_bytes(content)
    assert len(load_trial(run_id, uri).iterations) == 1
