"""A real SQLite store is written, and read back by another client."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from typing import Any, NoReturn
from urllib.parse import unquote, urlparse

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from mlflow import MlflowClient
from mlflow.entities import Run
from mlflow.store.artifact.local_artifact_repo import LocalArtifactRepository
from omegaconf import OmegaConf
from point_mass import PointMass, Spring

import simbias
from simbias.config import Composition, ConfigError
from simbias.core import Hardware, Policy
from simbias.core.commands import python
from simbias.core.records import (
    Array,
    Iteration,
    Learning,
    Optimum,
    Rollout,
    Search,
    Selection,
    Transitions,
)
from simbias.mlflow.fields import TRIAL_METRICS
from simbias.mlflow.none import NoTracking
from simbias.mlflow.store import connect
from simbias.mlflow.tracking import SPARING, Mlflow
from simbias.sweep.tracking import TrackedTrial
from simbias.trial.files import load_rollout, load_transitions
from simbias.trial.run import Outcome, TrialRecord
from simbias.trial.study import Study

pytestmark = pytest.mark.slow

THETA = np.array([0.5, 1.5, 2.0])
FRAMES = 7  # of an experiment
UI = f"{SPARING} {python()} -m mlflow ui --workers 1"
CHOICES = {
    "task": "point_mass",
    "method": "algorithm1",
    "nominal": "point_mass",
    "hardware": "point_mass",
    "bias": "gp",
    "optimizer": "nlopt_direct",
}
CONFIG = {
    "bias": {
        "_target_": "simbias.learning.bias.gp.GaussianProcess",
        "d": 1.0,
        "length_scale": 2.0,
        "signal_variance": 1.0,
        "noise_variance": 0.1,
        "input_scale": [1.0, 2.0],
        "inducing": None,
    },
    "tracking": {"uri": "http://me:secret@host/path"},
    "room": {"light": {"on": None}, "walls": {}},
}


class Doubling(Spring):
    def gains(self, theta: Array) -> Array:
        return 2.0 * theta[None]


def described(seed: int = 3, **config: Any) -> Study:
    """A study of the point mass, said to be composed of something small that is easily compared."""
    study = simbias.load([*POINT_MASS, "tracking=none"], OWN_CONF)
    task = PointMass(horizon=FRAMES)
    composition = Composition({**CONFIG, "seed": seed, **config}, CHOICES)
    return replace(study, task=task, policy=Doubling(task), seed=seed, composition=composition)


def rollout(seed: int, failed: bool = True) -> Rollout:
    rng = np.random.default_rng(seed)
    return Rollout(
        states=rng.normal(size=(FRAMES + 1, 2)),
        inputs=rng.normal(size=(FRAMES, 1)),
        failed_at=FRAMES if failed else None,
        failure="the wall | falls" if failed else None,
        cost=1000.0 + seed if failed else 12.0,
        measured=rng.normal(size=(FRAMES + 1, 2)) if failed else None,
        parameters=THETA,
    )


def iteration(index: int, succeeded: bool = False) -> Iteration:
    rng = np.random.default_rng(index)
    data = Transitions(rng.normal(size=(4 * (index + 1), 3)), rng.normal(size=(4 * (index + 1), 2)))
    new = Transitions(data.inputs[:4], data.residuals[:4])
    experiments = tuple(rollout(10 * index + j, not succeeded) for j in range(2))
    return Iteration(
        index=index,
        parameters=THETA + index,
        experiments=experiments,
        hardware_cost=max(r.cost for r in experiments),
        succeeded=succeeded,
        total_experiments=2 * (index + 1),
        search=Search(Optimum(THETA + index, 11.0, 123, "the relative tolerance"), 11.5, None, {"edge": 0.5}),
        learning=Learning(Selection(new, 14, 9, {"body_angle": 5}), data, reset=index == 1),
        seconds={"search": 1.5, "experiments": 0.5},
    )


def ended(outcome: Outcome, iterations: Sequence[Iteration] = (), **fields: Any) -> TrialRecord:
    """The record of a trial that ended so, a minute after it began."""
    words = {"max_experiments": 20, "max_iterations": 10, "started": time.time() - 60.0, "seconds": 60.0}
    return TrialRecord(outcome, tuple(iterations), **{**words, **fields})


def keep(trial: TrackedTrial, iterations: Sequence[Iteration], outcome: Outcome, **fields: Any) -> None:
    """What `run_trial` tells a recorder."""
    for each in iterations:
        trial.iterated(each)
    trial.ended(ended(outcome, iterations, **fields))


def three() -> list[Iteration]:
    """The iterations of a trial that succeeds."""
    return [iteration(0), iteration(1), iteration(2, succeeded=True)]


def uri(folder: Path) -> str:
    return f"sqlite:///{folder}/mlflow.db"


def open_trial(folder: Path, study: Study) -> TrackedTrial:
    return Mlflow(uri(folder), pictures=False).open(study)


def run_id(trial: TrackedTrial) -> str:
    return str(trial.run_id)  # type: ignore[attr-defined]


def read(folder: Path, trial: TrackedTrial | None = None) -> Run:
    """The run of a trial, or the only run, as another client sees it."""
    client = MlflowClient(tracking_uri=uri(folder))
    experiment = client.get_experiment_by_name("simbias")
    assert experiment is not None
    runs = list(client.search_runs([experiment.experiment_id]))
    assert trial is not None or len(runs) == 1
    return next(run for run in runs if trial is None or run_id(trial) == run.info.run_id)


def histories(folder: Path, run: Run) -> dict[str, list[tuple[int, float]]]:
    """Steps and values of every metric."""
    client = MlflowClient(tracking_uri=uri(folder))
    return {
        name: [(metric.step, metric.value) for metric in client.get_metric_history(run.info.run_id, name)]
        for name in run.data.metrics
    }


def artifact(run: Run, name: str) -> Path:
    return Path(unquote(urlparse(run.info.artifact_uri).path), name)


@pytest.fixture(scope="session")
def new_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with nothing in it: creating one takes a second."""
    folder = tmp_path_factory.mktemp("new store")
    connect(uri(folder), "another")
    return folder / "mlflow.db"


@pytest.fixture
def folder(new_store: Path, tmp_path: Path) -> Path:
    (tmp_path / "a folder").mkdir()
    (tmp_path / "a folder" / "mlflow.db").write_bytes(new_store.read_bytes())
    return tmp_path / "a folder"


def test_open_tells_what_runs(folder: Path) -> None:
    study = described()
    trial = open_trial(folder, study)
    run = read(folder)
    assert run.info.status == "RUNNING"
    assert run.info.run_name == "gp nlopt_direct seed 3"
    assert run.data.params == {
        **CHOICES,
        "bias._target_": "simbias.learning.bias.gp.GaussianProcess",
        "bias.d": "1.0",
        "bias.length_scale": "2.0",
        "bias.signal_variance": "1.0",
        "bias.noise_variance": "0.1",
        "bias.input_scale": "[1.0, 2.0]",
        "bias.inducing": "null",
        "tracking.uri": "http://host/path",
        "room.light.on": "null",
        "room.walls": "{}",
        "seed": "3",
    }
    assert run.data.tags["hash"] == study.composition.hash
    assert f", numpy {np.__version__}, " in run.data.tags["versions"]
    assert "**Running**, after 0 iterations" in run.data.tags["mlflow.note.content"]
    config: Any = OmegaConf.load(artifact(run, "config.yaml"))
    assert config.bias == CONFIG["bias"]
    assert "secret" not in artifact(run, "config.yaml").read_text()
    assert trial.where is not None
    assert "\n" not in trial.where
    page = f"/#/experiments/{run.info.experiment_id}/runs/{run.info.run_id}?workflowType=machine_learning"
    assert trial.where == f"{UI} --backend-store-uri '{uri(folder)}'  # http://127.0.0.1:5000{page}"
    assert trial.finished() is None


class Scripted(Hardware):
    def __init__(self, *rollouts: Rollout) -> None:
        self._rollouts = iter(rollouts)

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        return next(self._rollouts)


def test_every_call_is_written_when_it_returns(folder: Path) -> None:
    records = three()
    hardware = Scripted(*(rollout for record in records for rollout in record.experiments))
    trial = open_trial(folder, described())
    study = trial.recalling(replace(described(), hardware=hardware))
    journal = folder / "journals" / "simbias" / study.hash
    for index, record in enumerate(records):
        for j, experiment in enumerate(record.experiments):
            study.experiment(record.parameters, np.random.default_rng(0))
            kept = load_rollout(journal / f"{2 * index + j:04d}_experiment.npz")
            assert np.array_equal(kept.parameters, record.parameters)
            for name in ("states", "inputs", "measured"):
                assert np.array_equal(getattr(kept, name), getattr(experiment, name))
            assert (kept.failed_at, kept.failure) == (experiment.failed_at, experiment.failure)
            assert "cost/hardware_max" not in read(folder).data.metrics or index > 0
        trial.iterated(record)
        run = read(folder)
        check_iteration(run, record)
        assert run.data.metrics["experiments/total"] == 2 * (index + 1)
        assert f"**Running**, after {index + 1} iteration" in run.data.tags["mlflow.note.content"]
    trial.ended(ended(Outcome.SUCCEEDED, records))
    assert not (folder / "journals").exists()
    check_closed_run(folder)


def check_iteration(run: Run, record: Iteration) -> None:
    """The files of an iteration."""
    index = record.index
    for j, experiment in enumerate(record.experiments):
        kept = load_rollout(artifact(run, f"experiments/iteration_{index:02d}_experiment_{j}.npz"))
        for name in ("states", "inputs", "measured", "parameters"):
            assert np.array_equal(getattr(kept, name), getattr(experiment, name))
        for name in ("cost", "failed_at", "failure", "sensed"):
            assert getattr(kept, name) == getattr(experiment, name)
    policy = json.loads(artifact(run, f"policies/iteration_{index:02d}.json").read_text())
    assert policy["parameters"] == record.parameters.tolist()
    assert policy["gains"] == [(2 * record.parameters).tolist()]
    assert policy["search"] == {"cost": 11.0, "evaluations": 123, "stopped_by": "the relative tolerance"}
    data = load_transitions(artifact(run, f"data/iteration_{index:02d}.npz"))
    assert record.learning is not None
    assert np.array_equal(data.inputs, record.learning.data.inputs)
    assert np.array_equal(data.residuals, record.learning.data.residuals)


def check_closed_run(folder: Path) -> None:
    run = read(folder)
    assert run.info.status == "FINISHED"
    assert run.data.tags["outcome"] == "succeeded"
    note = run.data.tags["mlflow.note.content"]
    assert "**Succeeded** on hardware in iteration 2, after 3 iterations and 6 hardware experiments." in note
    row = "| 1 | 11.5 | 1011 | 8 | 2.0 | 2 of 2 experiments failed: the wall &#124; falls; model cleared |"
    assert row in note
    client = MlflowClient(tracking_uri=uri(folder))
    history = client.get_metric_history(run.info.run_id, "cost/hardware_max")
    assert [(m.step, m.value) for m in history] == [(0, 1001.0), (1, 1011.0), (2, 12.0)]
    expected = {
        "cost/predicted": 11.5,
        "cost/hardware_0": 12.0,
        "cost/hardware_1": 12.0,
        "experiments/iterations": 3.0,
        "experiments/failed": 0.0,
        "experiments/frames_min": 7.0,
        "experiments/succeeded": 1.0,
        "search/evaluations": 123.0,
        "bias/edge": 0.5,
        "model/reset": 0.0,
        "data/samples": 12.0,
        "data/new": 4.0,
        "data/frames": 14.0,
        "data/sampled": 9.0,
        "data/rejected_body_angle": 5.0,
        "seconds/search": 1.5,
        "seconds/experiments": 0.5,
        "trial/experiments": 6.0,
        "trial/iterations": 3.0,
        "trial/seconds": 60.0,
    }
    assert expected.items() <= run.data.metrics.items()
    with np.load(artifact(run, "data/iteration_00.npz")) as file:
        assert file["input_names"].tolist() == ["position", "velocity", "force"]
        assert file["input_units"].tolist() == ["m", "m/s", "N"]
        assert file["residual_names"].tolist() == ["position", "velocity"]
        assert file["residual_units"].tolist() == ["m", "m/s"]


REASONS = {
    Outcome.WAITING: {"reason": "run.csv is not there yet."},
    Outcome.ERROR: {"reason": "RuntimeError: the motor is hot", "traceback": "Traceback ..."},
}


@pytest.mark.parametrize(
    ("outcome", "status", "words"),
    [
        (Outcome.NOT_SUCCEEDED, "FINISHED", "**Did not succeed**"),
        (Outcome.INTERRUPTED, "KILLED", "**Interrupted**"),
        (Outcome.WAITING, "SCHEDULED", "**Waiting**"),
        (Outcome.ERROR, "FAILED", "`RuntimeError: the motor is hot`"),
    ],
)
def test_how_a_trial_ends(folder: Path, outcome: Outcome, status: str, words: str) -> None:
    trial = open_trial(folder, described())
    keep(trial, [iteration(0)], outcome, unfinished=(rollout(9),), **REASONS.get(outcome, {}))
    run = read(folder)
    assert (run.info.status, run.data.tags["outcome"]) == (status, outcome.value)
    note = run.data.tags["mlflow.note.content"]
    assert words in note
    assert "3 hardware experiments, 1 of them in an iteration that did not end" in note
    assert artifact(run, "error.txt").exists() == (status == "FAILED")
    assert run.data.tags.get("error", "") == REASONS.get(outcome, {}).get("reason", "")
    kept = load_rollout(artifact(run, "experiments/iteration_01_experiment_0.npz"))
    assert np.array_equal(kept.states, rollout(9).states)
    assert run.data.metrics.get("trial/experiments") == (20.0 if outcome.final else None)
    assert run.data.metrics["trial/seconds"] == 60.0


@pytest.mark.parametrize("outcome", [Outcome.INTERRUPTED, Outcome.WAITING, Outcome.ERROR, None])
def test_what_ended_early_goes_on_in_its_run(folder: Path, outcome: Outcome | None) -> None:
    """None is a kill, of which the store does not hear."""
    study = described()
    trial = open_trial(folder, study)
    if outcome is None:
        for each in three()[:2]:
            trial.iterated(each)
        trial._journal.release()  # type: ignore[attr-defined]  # as the system does
    else:
        keep(trial, three()[:2], outcome, **REASONS.get(outcome, {}))
    before = histories(folder, read(folder))
    again = open_trial(folder, study)
    run = read(folder)
    assert run_id(again) == run_id(trial) == run.info.run_id
    assert run.info.status == "RUNNING"
    assert not {"error", "outcome"} & run.data.tags.keys()
    assert again.finished() is None
    recalled = [replace(each, seconds={"search": 0.0}) for each in three()]
    keep(again, recalled, Outcome.SUCCEEDED)
    run = read(folder)
    assert (run.info.status, run.data.tags["outcome"]) == ("FINISHED", "succeeded")
    after = histories(folder, run)
    for name, history in after.items():
        if not name.startswith("trial/"):
            expected = 2 if name == "seconds/experiments" else 3
            assert [step for step, _ in history] == list(range(expected)), name
            assert history[:2] == before[name][:2]
    taken = 60.0 if outcome is None else 120.0
    assert run.data.metrics["trial/seconds"] == taken
    client = MlflowClient(tracking_uri=uri(folder))
    times = [m.timestamp for m in client.get_metric_history(run.info.run_id, "cost/predicted")]
    assert times == sorted(times)
    assert len(set(times)) > 1
    assert not (folder / "journals").exists()


def test_killed_before_its_state_is_written_a_trial_keeps_nothing_twice(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, trial = described(), open_trial(folder, described())

    def kill(*_: object, **__: object) -> NoReturn:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(MlflowClient, "set_terminated", kill)
        with pytest.raises(KeyboardInterrupt):
            keep(trial, three(), Outcome.SUCCEEDED)
    trial._journal.release()  # type: ignore[attr-defined]  # as the system does
    before = histories(folder, read(folder))
    keep(open_trial(folder, study), three(), Outcome.SUCCEEDED)
    run = read(folder)
    assert run.info.status == "FINISHED"
    after = histories(folder, run)
    for name in after.keys() - {"trial/seconds"}:
        assert after[name] == before[name], name


def test_an_error_that_is_mended_leaves_no_file(folder: Path) -> None:
    """A store that cannot remove files keeps it, and works."""
    for broken in (False, True):
        study = described(seed=int(broken))
        trial = open_trial(folder, study)
        keep(trial, [], Outcome.ERROR, **REASONS[Outcome.ERROR])
        error = artifact(read(folder, trial), "error.txt")
        assert error.exists()
        with pytest.MonkeyPatch.context() as patch:
            if broken:
                patch.setattr(LocalArtifactRepository, "delete_artifacts", full_disk)
            keep(open_trial(folder, study), [], Outcome.NOT_SUCCEEDED)
        assert error.exists() == broken
        assert read(folder, trial).info.status == "FINISHED"


def full_disk(*_: Any, **__: Any) -> None:
    raise OSError("disk full")


def test_a_run_that_cannot_be_ended_does_not_run_for_ever(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trial = open_trial(folder, described())
    with monkeypatch.context() as patch:
        patch.setattr(MlflowClient, "log_artifacts", full_disk)
        with pytest.raises(OSError, match="disk full"):
            keep(trial, [], Outcome.ERROR, **REASONS[Outcome.ERROR])
    assert read(folder).info.status == "FAILED"
    keep(open_trial(folder, described()), [], Outcome.NOT_SUCCEEDED)
    assert read(folder).info.status == "FINISHED"


def test_what_a_kill_left_half_copied_is_removed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At once where nobody else can write; of a trial that ended, whose pictures may be on the way, later."""
    study = described()
    trial = open_trial(folder, study)
    trial.iterated(iteration(0))
    left = artifact(read(folder), "policies/.artifact.uploading.x1")
    left.write_text("{")
    trial._journal.release()  # type: ignore[attr-defined]  # as the system does
    again = open_trial(folder, study)
    assert not left.exists()
    assert artifact(read(folder), "policies/iteration_00.json").exists()
    keep(again, [iteration(0)], Outcome.NOT_SUCCEEDED)
    left.write_text("{")
    open_trial(folder, study)
    assert left.exists()
    monkeypatch.setattr("simbias.mlflow.tracking.PICTURES_SECONDS", 0.0)
    open_trial(folder, study)
    assert not left.exists()


def test_what_a_kill_left_of_a_new_store_is_removed(tmp_path: Path) -> None:
    process = subprocess.Popen(["true"])
    process.wait()
    dead = [tmp_path / f".mlflow.db.{process.pid}.part{suffix}" for suffix in ("", "-journal", "-wal")]
    others = [tmp_path / name for name in (f".mlflow.db.{os.getppid()}.part", ".mlflow.db.x.part", "a.part")]
    for path in (*dead, *others):
        path.write_text("half")
    connect(uri(tmp_path), "simbias")
    assert not any(path.exists() for path in dead)
    assert all(path.exists() for path in others)
    assert {path.name for path in tmp_path.iterdir()} == {"mlflow.db", *(path.name for path in others)}


def test_a_trial_that_came_to_its_end_stays_as_it_is(folder: Path) -> None:
    study = simbias.load([*POINT_MASS, "tracking=none", "method.max_iterations=1"], OWN_CONF)
    (first,) = replace(study, hardware=study.hardware).run()
    keep(open_trial(folder, study), [first], Outcome.NOT_SUCCEEDED)
    run = read(folder)
    stale = folder / "journals" / "simbias" / study.hash  # of a process that was killed at the very end
    stale.mkdir(parents=True)
    again = open_trial(folder, study)
    trial = again.finished()
    assert trial is not None
    assert (trial.run_id, trial.study.hash) == (run.info.run_id, study.hash)
    assert [each.hardware_cost for each in trial.iterations] == [first.hardware_cost]
    assert again.where is not None
    assert f"/runs/{run.info.run_id}?" in again.where
    assert read(folder).to_dictionary() == run.to_dictionary()
    assert not (folder / "journals").exists()


def test_a_trial_that_a_sweep_ended_is_not_run_again(folder: Path) -> None:
    study = described()
    client, experiment_id = connect(uri(folder), "simbias")
    tags = {"hash": study.hash, "mlflow.parentRunId": "0" * 32}
    unfinished = client.create_run(experiment_id, tags=tags)
    trial = open_trial(folder, study)
    assert run_id(trial) != unfinished.info.run_id  # it is the sweep's own to go on with
    client.set_tag(unfinished.info.run_id, "outcome", Outcome.SUCCEEDED)
    for name in TRIAL_METRICS:
        client.log_metric(unfinished.info.run_id, name, 1.0)
    client.set_terminated(unfinished.info.run_id, "FINISHED")
    assert run_id(open_trial(folder, study)) == unfinished.info.run_id


def test_two_processes_do_not_run_the_same_trial(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simbias.trial.journal.LOCK_SECONDS", 0.1)
    trial = open_trial(folder, described())
    with pytest.raises(ConfigError, match="another process is running this trial"):
        open_trial(folder, described())
    assert read(folder).info.status == "RUNNING"  # the other's
    keep(trial, [], Outcome.INTERRUPTED)
    assert run_id(open_trial(folder, described())) == run_id(trial)


@pytest.mark.parametrize("given", [True, False])
def test_where_journals_are(folder: Path, tmp_path: Path, given: bool) -> None:
    store = Mlflow(uri(folder), "my / lab", pictures=False, journals=str(tmp_path / "own") if given else None)
    study = described()
    store.open(study)
    assert (tmp_path / "own" if given else folder / "journals").joinpath("my___lab", study.hash).is_dir()
    assert (folder / "journals").exists() is not given


@pytest.mark.parametrize("name", ["", "..", " .", "a\nb", "\x1b[31m"])
def test_an_experiments_name_is_one(name: str) -> None:
    with pytest.raises(ValueError, match=r"^experiment must be a name"):
        Mlflow(experiment=name)


def test_a_trial_that_cannot_be_described_is_no_running_run(folder: Path) -> None:
    indescribable = described(bias=object())
    for _ in range(2):  # nor does it keep anyone from trying again
        with pytest.raises(ConfigError, match="cannot represent an object"):
            open_trial(folder, indescribable)
        assert read(folder).info.status == "FAILED"


def test_what_was_not_written_at_the_beginning_is_added(folder: Path) -> None:
    """A process was killed between two batches of parameters."""
    study = described(task={f"p{i}": i for i in range(250)})
    client, experiment_id = connect(uri(folder), "simbias")
    run = client.create_run(experiment_id, tags={"hash": study.hash})
    client.log_param(run.info.run_id, "bias", "gp")
    open_trial(folder, study)
    whole = read(folder).data.params
    assert (len(whole), whole["task.p249"], whole["seed"]) == (267, "249", "3")


def test_an_iterations_metrics_are_there_all_or_none(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a trial so long that MLflow does not take its metrics at once."""
    sizes = []

    def fail_third(client: MlflowClient, run_id: str, metrics: Sequence[Any] = (), **rest: Any) -> None:
        if metrics:
            sizes.append(len(metrics))
            if len(sizes) == 3:
                raise ConnectionError
        log_batch(client, run_id, metrics=metrics, **rest)

    log_batch = MlflowClient.log_batch
    monkeypatch.setattr("simbias.mlflow.writes.METRICS", 50)
    monkeypatch.setattr(MlflowClient, "log_batch", fail_third)
    trial = open_trial(folder, described())
    with pytest.raises(ConnectionError):
        trial.keep(ended(Outcome.NOT_SUCCEEDED, [iteration(index) for index in range(10)]))  # type: ignore[attr-defined]
    run = read(folder)
    assert sizes[0] == sizes[1] <= 50
    steps = {tuple(step for step, _ in history) for history in histories(folder, run).values()}
    assert steps == {tuple(range(int(run.data.metrics["experiments/iterations"])))}


def test_pictures_are_kept(folder: Path) -> None:
    trial = open_trial(folder, described())
    keep(trial, [iteration(0)], Outcome.NOT_SUCCEEDED)
    trial.illustrated({"overview.png": b"colours", "forecast.txt": b"no picture"})
    run = read(folder)
    assert run.info.status == "FINISHED"
    assert artifact(run, "pictures/overview.png").read_bytes() == b"colours"
    assert artifact(run, "pictures/forecast.txt").read_bytes() == b"no picture"


def test_two_trials_in_one_store(folder: Path) -> None:
    trials = [open_trial(folder, described(seed)) for seed in (1, 2)]
    for trial, index in zip(trials, (0, 1), strict=True):
        trial.iterated(iteration(index))
    for trial, seed, samples in zip(trials, (1, 2), (4, 8), strict=True):
        run = read(folder, trial)
        assert run.data.params["seed"] == str(seed)
        assert run.data.metrics["data/samples"] == samples


def environment() -> dict[str, str]:
    """That of a process which runs this file's functions."""
    folders = [str(Path(__file__).parent), *sys.path]
    return os.environ | {"PYTHONPATH": os.pathsep.join(folders)}


def test_processes_share_a_store(folder: Path) -> None:
    """The experiment is created by whichever comes first."""
    code = (
        "import sys; from test_mlflow import *; folder = Path(sys.argv[1]);"
        "keep(open_trial(folder, described(int(sys.argv[2]))), three(), Outcome.SUCCEEDED)"
    )
    started = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(folder), str(seed)],
            cwd=folder,
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for seed in (1, 2)
    ]
    assert [(*process.communicate(timeout=60), process.returncode) for process in started] == [
        (b"", b"", 0)
    ] * 2
    client = MlflowClient(tracking_uri=uri(folder))
    experiment = client.get_experiment_by_name("simbias")
    assert experiment is not None
    runs = client.search_runs([experiment.experiment_id])
    assert sorted(run.data.params["seed"] for run in runs) == ["1", "2"]
    assert all(run.data.metrics["experiments/total"] == 6 for run in runs)


def test_new_store_is_created_silently_and_elsewhere_than_here(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    code = (
        "import sys; from test_mlflow import *;"
        "keep(open_trial(Path(sys.argv[1]), described()), [iteration(0)], Outcome.NOT_SUCCEEDED)"
    )
    command = [sys.executable, "-W", "error::ResourceWarning", "-c", code, str(there)]
    done = subprocess.run(command, cwd=here, env=environment(), capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
    assert not list(here.iterdir())
    assert {path.name for path in there.iterdir()} == {"mlflow.db", "mlartifacts"}
    assert artifact(read(there), "data/iteration_00.npz").is_relative_to(there / "mlartifacts")


def test_relative_uri_means_the_working_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    trial = Mlflow().open(described())
    ui = f"{SPARING} {python()} -m mlflow ui --workers 1"
    assert (trial.where or "").startswith(f"{ui} --backend-store-uri sqlite:///mlflow.db  # http")
    assert artifact(read(folder), "config.yaml").is_relative_to(folder / "mlartifacts")
    assert (folder / "journals").is_dir()


def test_many_and_long_parameters(folder: Path) -> None:
    many = {f"p{i}": i for i in range(250)}
    study = described(task={**many, "table": [[0.123456789] * 100] * 20, "a+b": "ü" * 7000})
    keep(open_trial(folder, study), [], Outcome.NOT_SUCCEEDED)
    run = read(folder)
    assert run.data.params["task.p249"] == "249"
    assert len(run.data.params["task.table"]) == len(run.data.params["task.a_b"]) == 6000
    assert run.data.params["task.table"].endswith("...")
    config: Any = OmegaConf.load(artifact(run, "config.yaml"))
    assert len(config.task.table) == 20


def bad_uris(folder: Path) -> Iterator[tuple[str, str]]:
    (folder / "text").write_text("no database " * 100)
    yield f"sqlite:///{folder}/missing/mlflow.db", "no folder"
    yield f"sqlite:///{folder}/text", "file is not a database"
    yield f"sqlite:///{folder}", "unable to open database file"
    yield "sqlite://", "in memory"
    yield "nonsense", "filesystem tracking backend"
    yield "foo://bar", "unsupported URI"
    yield "http://127.0.0.1:9", "refused"
    yield "http://me:secret@no-such-host.invalid", ""
    yield "postgresql://me:secret@127.0.0.1:9/x", ""


def test_bad_uri_ends_in_one_quick_line(tmp_path: Path) -> None:
    study = described()
    for address, message in bad_uris(tmp_path):
        start = time.perf_counter()
        with pytest.raises(ConfigError) as caught:
            Mlflow(address).open(study)
        assert time.perf_counter() - start < 5
        assert str(caught.value).startswith("tracking.uri: ")
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)
        assert "secret" not in str(caught.value)
        assert len(str(caught.value)) < 350


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
@pytest.mark.parametrize("name", ["mlflow.db", "new.db"])
def test_read_only_store(folder: Path, name: str) -> None:
    (folder / "mlflow.db").chmod(0o400)
    folder.chmod(0o500)
    with pytest.raises(ConfigError, match=r"tracking\.uri: .*(readonly database|unable to open)"):
        Mlflow(f"sqlite:///{folder}/{name}").open(described())
    folder.chmod(0o700)


def test_server_that_is_no_mlflow_is_refused_at_once() -> None:
    class Busy(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(503)

        def log_message(self, *_: Any) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Busy)
    Thread(target=server.serve_forever, daemon=True).start()
    study = described()
    start = time.perf_counter()
    with pytest.raises(ConfigError, match=r"tracking\.uri: .*503"):
        Mlflow(f"http://127.0.0.1:{server.server_port}").open(study)
    assert time.perf_counter() - start < 5
    server.shutdown()
    server.server_close()


def test_deleted_experiment(folder: Path) -> None:
    keep(open_trial(folder, described()), [], Outcome.NOT_SUCCEEDED)
    MlflowClient(tracking_uri=uri(folder)).delete_experiment(read(folder).info.experiment_id)
    with pytest.raises(ConfigError, match=r"tracking\.experiment: simbias is deleted"):
        Mlflow(uri(folder)).open(described())


def test_nothing_but_the_run_is_touched(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import mlflow

    monkeypatch.delenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", raising=False)
    keep(open_trial(folder, described()), [iteration(0)], Outcome.NOT_SUCCEEDED)
    assert mlflow.active_run() is None
    assert "MLFLOW_HTTP_REQUEST_MAX_RETRIES" not in os.environ
    assert logging.getLogger("mlflow").level == logging.WARNING


def test_module_import_leaves_mlflow_alone() -> None:
    code = "import sys, simbias.mlflow.tracking; assert 'mlflow' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_no_tracking_keeps_nothing() -> None:
    study = described()
    trial = NoTracking().open(study)
    assert trial.recalling(study) is study
    keep(trial, [iteration(0)], Outcome.ERROR)
    trial.illustrated({})
    assert (trial.where, trial.finished(), trial.pictures) == (None, None, ())
