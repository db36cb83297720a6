"""A real SQLite store is written, and read back by another client."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote, urlparse

import numpy as np
import pytest
from mlflow import MlflowClient
from mlflow.entities import Run
from omegaconf import OmegaConf
from omegaconf.errors import UnsupportedValueType

from simbias.config import ConfigError
from simbias.interfaces import Quantity, TrackedTrial
from simbias.records import Iteration, Optimum, Rollout, Selection, Transitions
from simbias.tracking.files import load_rollout, load_transitions
from simbias.tracking.mlflow import UI, Mlflow
from simbias.tracking.none import NoTracking
from simbias.tracking.store import connect

THETA = np.array([0.5, -1.5])


class DoublingPolicy:
    def gains(self, theta: np.ndarray) -> np.ndarray:
        return 2.0 * theta[None]


def fake_study(seed: int = 3, **config: Any) -> Any:
    return SimpleNamespace(
        task=SimpleNamespace(
            states=(Quantity("angle", "rad"), Quantity("rate", "rad/s")), inputs=(Quantity("torque", "N m"),)
        ),
        policy=DoublingPolicy(),
        seed=seed,
        hash="abc123def456",
        title="algorithm1 on pendulum",
        choices={"bias": "gp", "optimizer": "nlopt_direct"},
        config={
            "bias": {
                "_target_": "simbias.bias.gp.GP",
                "d": 1.0,
                "length_scale": [1.0, 2.0],
                "noise": {"on": None},
            },
            "tracking": {"uri": "http://me:secret@host/path"},
            "seed": seed,
            **config,
        },
    )


def rollout(seed: int, failed: bool = True) -> Rollout:
    rng = np.random.default_rng(seed)
    return Rollout(
        states=rng.normal(size=(8, 2)),
        inputs=rng.normal(size=(7, 1)),
        failed_at=7 if failed else None,
        failure="the board | leaves" if failed else None,
        cost=1000.0 + seed if failed else 12.0,
        measured=rng.normal(size=(8, 2)) if failed else None,
    )


def iteration(index: int, succeeded: bool = False) -> Iteration:
    rng = np.random.default_rng(index)
    data = Transitions(rng.normal(size=(4 * (index + 1), 3)), rng.normal(size=(4 * (index + 1), 2)))
    experiments = tuple(rollout(10 * index + j, not succeeded) for j in range(2))
    return Iteration(
        index=index,
        optimum=Optimum(THETA + index, 11.0, 123, "the relative tolerance"),
        predicted_cost=11.5,
        model_reset=index == 1,
        experiments=experiments,
        hardware_cost=max(r.cost or 0.0 for r in experiments),
        succeeded=succeeded,
        total_experiments=2 * (index + 1),
        selection=Selection(Transitions(data.inputs[:4], data.residuals[:4]), 14, 9, {"body_angle": 5}),
        data=data,
        fitted_bias=None,  # type: ignore[arg-type]
        seconds={"search": 1.5, "experiments": 0.5},
    )


def uri(folder: Path) -> str:
    return f"sqlite:///{folder}/mlflow.db"


def read(folder: Path, trial: TrackedTrial | None = None, address: str | None = None) -> Run:
    """The run of a trial, or the only run, as another client sees it."""
    client = MlflowClient(tracking_uri=address or uri(folder))
    experiment = client.get_experiment_by_name("simbias")
    assert experiment is not None
    runs = client.search_runs([experiment.experiment_id])
    return next(run for run in runs if trial is None or trial.run_id == run.info.run_id)  # type: ignore[attr-defined]


def artifact(run: Run, name: str) -> Path:
    return Path(unquote(urlparse(run.info.artifact_uri).path), name)


def run_experiments(trial: TrackedTrial, record: Iteration) -> None:
    for j, experiment in enumerate(record.experiments):
        trial.experimented(record.index, j, record.optimum.parameters, experiment)


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
    trial = Mlflow(uri(folder)).open(fake_study())
    run = read(folder)
    assert run.info.status == "RUNNING"
    assert run.info.run_name == "gp nlopt_direct seed 3"
    assert run.data.params == {
        "bias": "gp",
        "optimizer": "nlopt_direct",
        "bias._target_": "simbias.bias.gp.GP",
        "bias.d": "1.0",
        "bias.length_scale": "[1.0, 2.0]",
        "bias.noise.on": "null",
        "tracking.uri": "http://host/path",
        "seed": "3",
    }
    assert run.data.tags["hash"] == "abc123def456"
    assert f", numpy {np.__version__}, " in run.data.tags["versions"]
    assert "**Running**, after 0 iterations" in run.data.tags["mlflow.note.content"]
    config = OmegaConf.load(artifact(run, "config.yaml"))
    assert config.bias == fake_study().config["bias"]
    assert "secret" not in artifact(run, "config.yaml").read_text()
    assert trial.where is not None
    assert "\n" not in trial.where
    page = f"/#/experiments/{run.info.experiment_id}/runs/{run.info.run_id}?workflowType=machine_learning"
    assert trial.where == f"{UI} --backend-store-uri '{uri(folder)}'  # http://127.0.0.1:5000{page}"


def test_every_call_is_written_when_it_returns(folder: Path) -> None:
    trial = Mlflow(uri(folder)).open(fake_study())
    for index in range(3):
        record = iteration(index, succeeded=index == 2)
        for j, experiment in enumerate(record.experiments):
            trial.experimented(index, j, record.optimum.parameters, experiment)
            path = artifact(read(folder), f"experiments/iteration_{index:02d}_experiment_{j}.npz")
            theta, kept = load_rollout(path)
            assert np.array_equal(theta, record.optimum.parameters)
            for name in ("states", "inputs", "measured"):
                assert np.array_equal(getattr(kept, name), getattr(experiment, name))
            assert (kept.cost, kept.failed_at, kept.failure) == (
                experiment.cost,
                experiment.failed_at,
                experiment.failure,
            )
            assert "cost/hardware_max" not in read(folder).data.metrics or index > 0
        trial.log(record)
        run = read(folder)
        assert run.data.metrics["experiments/total"] == 2 * (index + 1)
        assert f"**Running**, after {index + 1} iteration" in run.data.tags["mlflow.note.content"]
        policy = json.loads(artifact(run, f"policies/iteration_{index:02d}.json").read_text())
        assert policy["parameters"] == record.optimum.parameters.tolist()
        assert policy["gains"] == [(2 * record.optimum.parameters).tolist()]
        assert policy["search"] == {"cost": 11.0, "evaluations": 123, "stopped_by": "the relative tolerance"}
        data = load_transitions(artifact(run, f"data/iteration_{index:02d}.npz"))
        assert np.array_equal(data.inputs, record.data.inputs)
        assert np.array_equal(data.residuals, record.data.residuals)
    trial.close()
    check_closed_run(folder)


def check_closed_run(folder: Path) -> None:
    run = read(folder)
    assert run.info.status == "FINISHED"
    assert run.data.tags["outcome"] == "succeeded"
    note = run.data.tags["mlflow.note.content"]
    assert "**Succeeded** on hardware in iteration 2, after 3 iterations and 6 hardware experiments." in note
    assert (
        "| 1 | 11.5 | 1011 | 8 | 2.0 | 2 of 2 experiments failed: the board / leaves; model cleared |" in note
    )
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
        "model/reset": 0.0,
        "data/samples": 12.0,
        "data/new": 4.0,
        "data/frames": 14.0,
        "data/sampled": 9.0,
        "data/rejected_body_angle": 5.0,
        "seconds/search": 1.5,
        "seconds/experiments": 0.5,
    }
    assert expected.items() <= run.data.metrics.items()
    with np.load(artifact(run, "data/iteration_00.npz")) as file:
        assert file["input_names"].tolist() == ["angle", "rate", "torque"]
        assert file["input_units"].tolist() == ["rad", "rad/s", "N m"]
        assert file["residual_names"].tolist() == ["angle", "rate"]
        assert file["residual_units"].tolist() == ["rad", "rad/s"]


@pytest.mark.parametrize(
    ("error", "status", "outcome", "words"),
    [
        (None, "FINISHED", "not succeeded", "**Did not succeed**"),
        (KeyboardInterrupt(), "KILLED", "interrupted", "**Interrupted**"),
        (SystemExit(143), "KILLED", "interrupted", "**Interrupted**"),
        (RuntimeError("the motor is hot"), "FAILED", "error", "`RuntimeError: the motor is hot`"),
    ],
)
def test_how_a_trial_ends(
    folder: Path, error: BaseException | None, status: str, outcome: str, words: str
) -> None:
    trial = Mlflow(uri(folder)).open(fake_study())
    run_experiments(trial, iteration(0))
    trial.log(iteration(0))
    trial.experimented(1, 0, THETA, rollout(9))
    trial.close(error)
    run = read(folder)
    assert (run.info.status, run.data.tags["outcome"]) == (status, outcome)
    note = run.data.tags["mlflow.note.content"]
    assert words in note
    assert "3 hardware experiments, 1 of them in an iteration that did not end" in note
    assert artifact(run, "error.txt").exists() == (status == "FAILED")


def test_a_trial_that_cannot_be_described_is_no_running_run(folder: Path) -> None:
    with pytest.raises(UnsupportedValueType):
        Mlflow(uri(folder)).open(fake_study(bias=object()))
    assert read(folder).info.status == "FAILED"


def test_two_trials_in_one_store(folder: Path) -> None:
    trials = [Mlflow(uri(folder)).open(fake_study(seed)) for seed in (1, 2)]
    for trial, index in zip(trials, (0, 1), strict=True):
        run_experiments(trial, iteration(index))
        trial.log(iteration(index))
    for trial, seed, samples in zip(trials, (1, 2), (4, 8), strict=True):
        run = read(folder, trial)
        assert run.data.params["seed"] == str(seed)
        assert run.data.metrics["data/samples"] == samples


def test_processes_share_a_store(folder: Path) -> None:
    """The experiment is created by whichever comes first."""
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); from test_mlflow import *;"
        "trial = Mlflow(sys.argv[2]).open(fake_study(int(sys.argv[3])));"
        "[(run_experiments(trial, iteration(i)), trial.log(iteration(i))) for i in range(3)]; trial.close()"
    )
    command = [sys.executable, "-c", code, str(Path(__file__).parent), uri(folder)]
    started = [
        subprocess.Popen([*command, str(seed)], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
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
        "import sys; sys.path.insert(0, sys.argv[1]); from test_mlflow import *;"
        "trial = Mlflow(sys.argv[2]).open(fake_study()); trial.log(iteration(0)); trial.close()"
    )
    command = [
        sys.executable,
        "-W",
        "error::ResourceWarning",
        "-c",
        code,
        str(Path(__file__).parent),
        uri(there),
    ]
    done = subprocess.run(command, cwd=here, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
    assert not list(here.iterdir())
    assert {path.name for path in there.iterdir()} == {"mlflow.db", "mlartifacts"}
    assert artifact(read(there), "data/iteration_00.npz").is_relative_to(there / "mlartifacts")


def test_relative_uri_means_the_working_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    trial = Mlflow().open(fake_study())
    assert (trial.where or "").startswith(f"{UI} --backend-store-uri sqlite:///mlflow.db  # http")
    assert artifact(read(folder), "config.yaml").is_relative_to(folder / "mlartifacts")


def test_many_and_long_parameters(folder: Path) -> None:
    many = {f"p{i}": i for i in range(250)}
    trial = Mlflow(uri(folder)).open(
        fake_study(task={**many, "table": [[0.123456789] * 100] * 20, "a+b": "ü" * 7000})
    )
    trial.close()
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
    for address, message in bad_uris(tmp_path):
        start = time.perf_counter()
        with pytest.raises(ConfigError) as caught:
            Mlflow(address).open(fake_study())
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
        Mlflow(f"sqlite:///{folder}/{name}").open(fake_study())
    folder.chmod(0o700)


def test_server_that_is_no_mlflow_is_refused_at_once() -> None:
    class Busy(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(503)

        def log_message(self, *_: Any) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Busy)
    Thread(target=server.serve_forever, daemon=True).start()
    start = time.perf_counter()
    with pytest.raises(ConfigError, match=r"tracking\.uri: .*503"):
        Mlflow(f"http://127.0.0.1:{server.server_port}").open(fake_study())
    assert time.perf_counter() - start < 5
    server.shutdown()
    server.server_close()


def test_deleted_experiment(folder: Path) -> None:
    trial = Mlflow(uri(folder)).open(fake_study())
    trial.close()
    MlflowClient(tracking_uri=uri(folder)).delete_experiment(read(folder).info.experiment_id)
    with pytest.raises(ConfigError, match=r"tracking\.experiment: simbias is deleted"):
        Mlflow(uri(folder)).open(fake_study())


def test_nothing_but_the_run_is_touched(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import mlflow

    monkeypatch.delenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", raising=False)
    Mlflow(uri(folder)).open(fake_study()).close()
    assert mlflow.active_run() is None
    assert "MLFLOW_HTTP_REQUEST_MAX_RETRIES" not in os.environ
    assert logging.getLogger("mlflow").level == logging.WARNING


def test_module_import_leaves_mlflow_alone() -> None:
    code = "import sys, simbias.tracking.mlflow; assert 'mlflow' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_no_tracking_keeps_nothing() -> None:
    trial = NoTracking().open(fake_study())
    run_experiments(trial, iteration(0))
    trial.log(iteration(0))
    trial.close(RuntimeError())
    assert trial.where is None
