"""Folders of trials in MLflow: live, later or again, always the same pages."""

import multiprocessing
import os
import re
import shutil
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import pytest
from conftest import OWN_CONF, POINT_MASS
from hardware import counted
from in_numpy import simulate_in_numpy
from mlflow import MlflowClient
from mlflow.entities import Run
from mlflow_ui import free_port, is_up
from processes import wait_for
from records import assert_equal
from texts import write

import simbias
from simbias.__main__ import main
from simbias.config import ConfigError
from simbias.core import Hardware, HardwareError
from simbias.core.records import Iteration
from simbias.mlflow import runs
from simbias.mlflow.pages import NOTE
from simbias.mlflow.runs import Runs
from simbias.mlflow.tracking import Mlflow
from simbias.trial.folder import TRIAL, TrialFolder, withdraw
from simbias.trial.observer import Observer, Observers
from simbias.trial.run import run_trial
from simbias.trial.study import Study

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("uncompiled")]

SHORT = ["tracking=none", "task.horizon=50", "optimizer.max_evaluations=20", "method.max_iterations=2"]


@cache
def study(seed: int = 0) -> Study:
    return simbias.load([*POINT_MASS, *SHORT, f"seed={seed}"], OWN_CONF)


class Broken(Hardware):
    def run(self, *_: Any) -> NoReturn:
        raise HardwareError("the motor | is hot")


class Stop(Observer):
    def iterated(self, iteration: Iteration) -> None:
        raise KeyboardInterrupt


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of trials, each of which stands otherwise: its seed tells."""
    trials = tmp_path_factory.mktemp("made") / "trials"
    with pytest.MonkeyPatch.context() as patch:
        simulate_in_numpy(patch)  # for a module
        make(trials)
    return trials


def make(trials: Path) -> None:
    """Trials that ended, was killed, waits, failed and was interrupted."""
    finished, killed = (run_trial(study(seed), trials / study(seed).hash) for seed in (0, 1))
    assert finished.outcome.final
    assert killed.outcome.final
    folder = TrialFolder(trials / study(1).hash)
    for file in (folder.steps()[-1], folder.path / "outcome.json"):
        file.unlink()
    run_trial(counted(study(2), slow=True)[0], trials / study(2).hash)
    run_trial(replace(study(3), hardware=Broken()), trials / study(3).hash)
    with pytest.raises(KeyboardInterrupt):
        run_trial(study(4), trials / study(4).hash, Stop())


@pytest.fixture
def folder(made: Path, new_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with these trials and two stores in which nothing is."""
    shutil.copytree(made, tmp_path / "trials")
    for name in ("mlflow.db", "other.db"):
        shutil.copy(new_store, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def uri(folder: Path, name: str = "mlflow.db") -> str:
    return f"sqlite:///{folder}/{name}"


def found_runs(client: MlflowClient, *search: str, **order: Any) -> list[Run]:
    """The runs of the experiment."""
    experiment = client.get_experiment_by_name("simbias")
    assert experiment is not None
    return list(client.search_runs([experiment.experiment_id], *search, **order))


def at(folder: Path, seed: int = 0) -> Path:
    """The folder of a trial."""
    return folder / "trials" / study(seed).hash


def export(address: str, trials: Path) -> list[str]:
    return list(Mlflow(address, trials=str(trials)).export())


def export_all(folder: Path) -> list[str]:
    return export(uri(folder), folder / "trials")


def exported_again(folder: Path) -> dict[str, dict[str, Any]]:
    """The pages of the other store."""
    export(uri(folder, "other.db"), folder / "trials")
    return pages(uri(folder, "other.db"))


def pages(address: str) -> dict[str, dict[str, Any]]:
    """All that the runs of a store hold, by their seed, but for their ids."""
    client = MlflowClient(address)
    runs = found_runs(client)
    found = {run.data.params["seed"]: page(client, run) for run in runs}
    assert len(found) == len(runs)
    return dict(sorted(found.items()))


def page(client: MlflowClient, run: Run) -> dict[str, Any]:
    """A run."""
    histories = {}
    for name in run.data.metrics:
        points = client.get_metric_history(run.info.run_id, name)
        histories[name] = [(point.step, point.timestamp, point.value) for point in points]
        assert len({point.step for point in points}) == len(points), name
    root = Path(client.download_artifacts(run.info.run_id, ""))
    files = sorted(file for file in root.rglob("*") if file.is_file())
    return {
        "name": run.info.run_name,
        "status": run.info.status,
        "start": run.info.start_time,
        "params": run.data.params,
        "tags": run.data.tags,
        "metrics": histories,
        "files": {str(file.relative_to(root)): file.read_bytes() for file in files},
    }


def test_an_export_again_changes_nothing_and_a_deleted_store_is_made_again(folder: Path) -> None:
    """Every trial has its page, also where one run, or all files, were gone."""
    assert export_all(folder) == ["5 trials in no sweep"]
    found = pages(uri(folder))
    export_all(folder)
    assert pages(uri(folder)) == found
    client = MlflowClient(uri(folder))
    client.delete_run(found_runs(client)[0].info.run_id)
    export_all(folder)
    assert pages(uri(folder)) == found == exported_again(folder)
    finished, trial = found["0"], TrialFolder(at(folder, 0))
    ended = trial.summary()
    assert ended is not None
    assert [(each["status"], each["tags"].get("outcome")) for each in found.values()] == [
        ("FINISHED", str(ended.outcome)),
        ("KILLED", None),
        ("SCHEDULED", "waiting"),
        ("FAILED", "error"),
        ("KILLED", "interrupted"),
    ]
    assert found["3"]["tags"]["error"] == "HardwareError: the motor | is hot"
    assert "error" not in found["2"]["tags"]
    assert found["2"]["tags"]["waiting"] == "trajectory.csv is not there yet."
    assert "trial/error_0000.txt" in found["3"]["files"]
    assert finished["params"]["optimizer.max_evaluations"] == "20"
    assert finished["params"]["task"] == "point_mass"
    assert {"config.yaml", *(f"trial/{file.name}" for file in trial.files())} == {*finished["files"]}
    totals = [
        (each["iteration"], int(1000 * each["ended"]), 2.0 * each["iteration"] + 2)
        for each in trial.iterations()
    ]
    assert finished["metrics"]["experiments/total"] == totals
    seconds = [(0, int(1000 * ended.ended), ended.hardware_seconds)]
    assert finished["metrics"]["trial/hardware_seconds"] == seconds


def test_a_trial_goes_on_in_a_new_run_after_a_withdrawal(folder: Path) -> None:
    """The run before it says so; a new store has the new one alone. Others end in the run that they have.

    These were killed, waited, failed or were interrupted. One that is made again has another.
    """
    export_all(folder)
    before, client = pages(uri(folder)), MlflowClient(uri(folder))
    trial = TrialFolder(at(folder, 0))
    withdrawal = withdraw(trial.steps()[1], "a loose cable")
    for status, resumes in (("KILLED", False), ("FINISHED", True)):
        if resumes:
            for seed in range(5):
                run_trial(study(seed), at(folder, seed))
        export_all(folder)
        new, old = found_runs(client, "params.seed = '0'", order_by=["start_time DESC"])
        assert (new.info.status, old.info.status) == (status, "FINISHED")
        assert old.data.tags["outcome"] == "superseded"
        note = old.data.tags[NOTE]
        assert f"[a new run](#/experiments/{new.info.experiment_id}/runs/{new.info.run_id}" in note
        assert note.count("Superseded") == 1
        assert f"**Withdrawn**: {withdrawal}." in new.data.tags[NOTE]
    tags = {"hash": study(0).hash, "outcome": "superseded"}
    later = client.create_run(new.info.experiment_id, tags=tags)  # as if the clock had been set back
    assert f"/runs/{new.info.run_id}" in Runs(uri(folder), "simbias", folder).page(study(0).hash)
    for each in (old, later):
        client.delete_run(each.info.run_id)
    after = pages(uri(folder))
    assert exported_again(folder) == after
    assert {each["status"] for each in after.values()} == {"FINISHED"}
    assert all(after[seed]["start"] == before[seed]["start"] for seed in "1234")
    assert not any({"error", "waiting"} & each["tags"].keys() for each in after.values())
    shutil.rmtree(trial.path)
    run_trial(study(0), trial.path)
    export_all(folder)
    assert len(found_runs(client)) == 6


def test_exports_at_once_make_one_run_of_a_trial(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two users, or two installations: both look for it before either makes it, or writes its numbers."""
    find, bring = Runs.find, runs.RunExport.bring

    def slowly(*arguments: Any) -> list[Run]:
        found = find(*arguments)
        time.sleep(0.2)
        return found

    def late(*arguments: Any) -> None:
        time.sleep(0.2)
        bring(*arguments)

    monkeypatch.setattr(Runs, "find", slowly)
    monkeypatch.setattr(runs.RunExport, "bring", late)
    monkeypatch.setattr(runs, "cache_folder", lambda _: Path(tempfile.mkdtemp(dir=folder)))
    exports = [Mlflow(uri(folder), trials=str(folder / "trials")).export_trial(at(folder)) for _ in "ab"]
    with ThreadPoolExecutor(2) as threads:
        list(threads.map(lambda each: each.update(), exports))
    assert [*pages(uri(folder))] == ["0"]


def test_a_trial_is_shown_while_it_runs(folder: Path) -> None:
    """Each iteration is logged as it ends."""
    shutil.rmtree(folder / "trials")
    store, seen = Mlflow(uri(folder)), []

    class Looking(Observer):
        def iterated(self, iteration: Iteration) -> None:
            seen.append(pages(uri(folder))["0"])

    shown = store.export_trial(at(folder))
    record = run_trial(study(), at(folder), Observers(shown, Looking()))
    for index, each in enumerate(seen):
        assert [step for step, *_ in each["metrics"]["experiments/total"]] == list(range(index + 1))
        assert each["status"] == "RUNNING"
        assert "**Running**" in each["tags"]["mlflow.note.content"]
        assert f"trial/{4 * index + 3:04d}_iteration.json" in each["files"]
    assert len(seen) == len(record.iterations) > 0
    shown.update(final=True)
    live = pages(uri(folder))
    assert live["0"]["status"] == "FINISHED"
    assert f" -m simbias ui {study().hash} tracking.uri=" in shown.where
    assert exported_again(folder) == live


def test_a_trial_is_read_back_by_its_folder_and_by_its_run(folder: Path) -> None:
    record = run_trial(study(), at(folder))
    (at(folder) / "videos" / "of today").mkdir(parents=True)
    (at(folder) / "videos" / "of today" / "1.mp4").write_bytes(b"what a person put there")
    export_all(folder)
    client = MlflowClient(uri(folder))
    (run,) = found_runs(client, "params.seed = '0'")
    experiment_id = run.info.experiment_id
    for trial in (at(folder), run.info.run_id):
        assert_equal(simbias.load_trial(trial, uri=uri(folder), config_dir=OWN_CONF), record)
    foreign = client.create_run(experiment_id).info.run_id
    sweep = client.create_run(experiment_id, tags={"hash": "abc", "sweep": "mine"}).info.run_id
    lost = client.create_run(experiment_id, tags={"hash": "abc"}).info.run_id
    missing = "no such run in sqlite:.*, and no such folder"
    said = (missing, missing, "is not a run of simbias", "is a sweep", "its files are not in the store")
    for name, message in zip(("0" * 32, "trials/none", foreign, sweep, lost), said, strict=True):
        with pytest.raises(ConfigError, match=f"^{name}: {message}"):
            simbias.load_trial(name, uri=uri(folder))
    with pytest.raises(ConfigError, match=r"^trials/none: no such folder, and no store sqlite:"):
        simbias.load_trial("trials/none", uri=uri(folder, "none.db"))
    assert not (folder / "none.db").exists()
    with pytest.raises(TypeError, match="positional"):
        simbias.load_trial(at(folder), "conf")  # type: ignore[misc]


def test_a_folder_that_cannot_be_read_is_named_and_stops_no_other(
    folder: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor does a copy, which would count twice."""
    (at(folder, 0) / TRIAL).write_text("{")
    shutil.copytree(at(folder, 1), folder / "trials" / "copy")
    for name in ("sweep", "state"):
        write(folder / "trials" / "sweeps" / name, {"sweep.json": '{"trials": {}}', f"{name}.json": "{"})
    assert main(["export", f"tracking.uri={uri(folder)}"]) == 1
    assert capsys.readouterr().out == "4 trials in no sweep\n"
    said = "\n".join(each.getMessage() for each in caplog.records)
    assert len(caplog.records) == 4
    for name in ("sweep", "state"):
        assert re.search(rf"sweeps/{name}/{name}\.json: cannot be read .*\. Delete it: ", said)
    assert f"{study(0).hash}/{TRIAL}: cannot be read" in said
    assert f"copy: is a copy of trial {study(1).hash}, which lies beside it" in said
    assert [*pages(uri(folder))] == ["1", "2", "3", "4"]
    with pytest.raises(ConfigError, match=r"none: is not the folder of a trial, of a sweep or of trials$"):
        export(uri(folder), folder / "none")


def test_a_damaged_step_is_named_although_the_trial_is_shown(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cut, short, gone = (TrialFolder(at(folder, seed)) for seed in (0, 1, 3))
    experiment = next(step for step in cut.steps() if step.suffix == ".npz")
    experiment.write_bytes(experiment.read_bytes()[:-30])
    short.steps()[0].unlink()
    (gone.path / TRIAL).unlink()
    assert main(["export", f"tracking.uri={uri(folder)}"]) == 1
    assert [*pages(uri(folder))] == ["0", "1", "2", "4"]
    said = [each.getMessage() for each in caplog.records]
    for words in (
        rf"a trial is damaged: .*{cut.path.name}/{experiment.name}: cannot be read \(",
        rf"a trial is damaged: .*{short.path.name}/0000_\*: is missing\. Put it back",
        rf"{gone.path.name}: is not the folder of a trial \(it has no {TRIAL}\)",
    ):
        assert sum(bool(re.search(words, each)) for each in said) == 1


def test_a_folder_of_a_trial_or_of_trials_is_exported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(at(folder, 1))
    for places, seeds in (
        (["."], "1"),
        ([f"../{study(seed).hash}" for seed in (0, 3)], "013"),
        ([".."], "01234"),
    ):
        assert main(["export", f"tracking.uri={uri(folder)}", *places]) == 0
        assert [*pages(uri(folder))] == [*seeds]


def test_many_and_long_parameters(folder: Path) -> None:
    shutil.rmtree(folder / "trials")
    config = {**study().config, "many": {f"p{i}": i for i in range(250)}, "a+b": "ü" * 7000}
    composition = replace(study().composition, config=config)  # type: ignore[type-var]
    run_trial(replace(study(), composition=composition), folder / "trials" / "many")
    export_all(folder)
    (found,) = pages(uri(folder)).values()
    assert (found["params"]["many.p249"], len(found["params"]["a_b"])) == ("249", 6000)
    assert found["files"]["config.yaml"].count("ü".encode()) == 7000


def test_a_store_that_fails_in_the_middle_lacks_nothing_later(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """At any call to it; the same exporter catches up."""
    shutil.rmtree(folder / "trials")
    failing = ("create_run", "log_artifacts", "log_batch", "set_terminated")

    def fail(*_: Any, **__: Any) -> NoReturn:
        raise ConnectionError("gone")

    for seed, name in enumerate(failing):
        trial = at(folder, seed)
        shown = Mlflow(uri(folder)).export_trial(trial)
        with monkeypatch.context() as patch:
            patch.setattr(MlflowClient, name, fail)
            record = run_trial(study(seed), trial, shown)
            shown.update()
        assert record.outcome.final
        shown.update(final=True)
    assert [each.getMessage().count("gone. All is kept in ") for each in caplog.records] == [1, 0] * len(
        failing
    )
    found = pages(uri(folder))
    assert [each["status"] for each in found.values()] == ["FINISHED"] * len(failing)
    assert exported_again(folder) == found


def serve(folder: Path, port: int) -> None:
    """MLflow's server of a store, without its command line and workers, which import MLflow again."""
    from mlflow.server import app, constants

    os.environ[constants.BACKEND_STORE_URI_ENV_VAR] = uri(folder)
    os.environ[constants.ARTIFACT_ROOT_ENV_VAR] = "mlflow-artifacts:/"
    os.environ[constants.ARTIFACTS_DESTINATION_ENV_VAR] = f"{folder}/files"
    os.environ[constants.SERVE_ARTIFACTS_ENV_VAR] = "true"
    app.run("127.0.0.1", port)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of a fork
def test_a_server_that_is_away_loses_nothing_and_stops_nothing(
    folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Away at the start; back, `export` catches up; killed in the middle; and back in the middle."""
    shutil.rmtree(folder / "trials")
    port = free_port()
    address, trials = f"http://127.0.0.1:{port}", folder / "trials"
    store = Mlflow(address, trials=str(trials))
    began = time.monotonic()
    shown = store.export_trial(at(folder, 0))
    assert run_trial(study(0), at(folder, 0), shown).outcome.final
    shown.update(final=True)
    assert time.monotonic() - began < 30
    (warning,) = [each.getMessage() for each in caplog.records]
    assert f"{address}: " in warning
    command = f"-m simbias export tracking.uri={address} tracking.trials={trials}"
    assert shown.where.startswith(f"{at(folder, 0)}; in MLflow, once the store works:  ")
    assert shown.where.endswith(command)
    assert f"All is kept in {trials}; once the store works, show it with:  " in warning
    assert warning.endswith(command)
    with pytest.raises(ConfigError, match=rf"^tracking\.uri: {address}: "):
        export(address, trials)
    server = multiprocessing.get_context("fork").Process(target=serve, args=(folder, port), daemon=True)
    server.start()

    class Killing(Observer):
        def iterated(self, iteration: Iteration) -> None:
            server.kill()
            server.join()

    wait_for(lambda: is_up(address))
    assert export(address, trials) == ["1 trial in no sweep"]
    found = pages(address)
    shown = Mlflow(address, trials=str(trials)).export_trial(at(folder, 1))
    record = run_trial(study(1), at(folder, 1), Observers(shown, Killing()))
    shown.update(final=True)
    assert record.outcome.final
    assert len(record.iterations) > 1
    assert len(caplog.records) == 2
    assert shown.where.startswith(f"{at(folder, 1)}; in MLflow, once ")  # no page of the dead server
    again = exported_again(folder)
    assert [each["status"] for each in again.values()] == ["FINISHED"] * 2
    assert found.items() <= again.items()
    monkeypatch.setattr(runs, "RETRY_SECONDS", 0.0)
    monkeypatch.setattr(runs, "RETRY_SHARE", 1e9)
    server = multiprocessing.get_context("fork").Process(target=serve, args=(folder, port), daemon=True)

    class Starting(Observer):
        def iterated(self, iteration: Iteration) -> None:
            if not server.pid:
                server.start()
                wait_for(lambda: is_up(address))

    shown = Mlflow(address, trials=str(trials)).export_trial(at(folder, 2))
    run_trial(study(2), at(folder, 2), Observers(shown, Starting()))
    assert [each.getMessage() for each in caplog.records][3:] == [f"simbias: MLflow: {address} works again"]
    assert pages(address)["2"]["metrics"]["experiments/total"]
    server.kill()
    server.join()
