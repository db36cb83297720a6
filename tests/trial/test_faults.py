"""Hardware that misbehaves, as a person meets it: one line, nothing lost, and the same command goes on."""

from __future__ import annotations

import re
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from faulty_hardware import DEADLY, LEFT, MENDED, RETURNED
from mlflow import MlflowClient
from mlflow.entities import Run
from sweeping import QUICK, artifacts, run, runs, write_sweep

from simbias.__main__ import main

pytestmark = pytest.mark.slow

SHORT = [*QUICK, "cost.max_cost=1e-3", "hardware=faulty"]  # it never succeeds
NO_PICTURES = "tracking.pictures=false"
SWEEP = """
task: {{horizon: 200}}
optimizer: {{max_evaluations: 20}}
method: {{max_iterations: 1}}
cost: {{max_cost: 1e-3}}
tracking: {{pictures: false}}
sweep:
  trials: 1
  axes:
    hardware.fault: [{faults}]
"""


@pytest.fixture(scope="session")
def conf(new_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a store in which nothing ran, and with the faulty hardware."""
    folder = tmp_path_factory.mktemp("faulty")
    (folder / "conf" / "hardware").mkdir(parents=True)
    (folder / "conf" / "hardware" / "faulty.yaml").write_text(
        "_target_: faulty_hardware.Faulty\nfault: none\n"
    )
    (folder / "conf" / "components.yaml").write_text("allow: [faulty_hardware]\n")
    shutil.copy(new_store, folder)
    return folder


@pytest.fixture
def folder(conf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder."""
    shutil.copytree(conf, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def only_run() -> Run:
    client = MlflowClient(tracking_uri=f"sqlite:///{Path.cwd()}/mlflow.db")
    experiment = client.get_experiment_by_name("simbias")
    assert experiment is not None
    (only,) = client.search_runs([experiment.experiment_id])
    return only


def trial(fault: str, *more: str) -> int:
    """The exit status; the URI is absolute, since MLflow keeps what a relative one meant at first."""
    store = [] if "tracking=none" in more else [NO_PICTURES, f"tracking.uri=sqlite:///{Path.cwd()}/mlflow.db"]
    return main(["--config-dir", "conf", *SHORT, *store, f"hardware.fault='{fault}'", *more])


@pytest.mark.parametrize(
    "fault", ["zero division", "speechless", "no UTF-8", "exit", "30 GB", "columns", "list"]
)
def test_a_trial_ends_in_one_line(folder: Path, capsys: pytest.CaptureFixture[str], fault: str) -> None:
    """What the hardware returned is kept; mended, the same command goes on, and leaves no old error."""
    assert trial(fault) == 1
    line = capsys.readouterr().err
    expected = r"simbias: HardwareError: Faulty\.run: .*expected .*, got .* \(1 hardware experiment kept; "
    assert re.match(expected + r"traceback in (.*); go on with:  .*\)\n$", line), line
    (journal,) = (folder / "journals" / "simbias").iterdir()
    trace = (journal / "error.txt").read_text()
    assert f"traceback in {journal / 'error.txt'};" in line
    assert "Traceback" in trace
    assert "faulty_hardware.py" in trace or fault in RETURNED
    kept = {path.name for path in journal.glob("refused_*")}
    assert kept == ({"refused_0000.npz", "refused_0000.txt"} if fault in RETURNED else set())
    failed = only_run()
    assert (failed.info.status, failed.data.tags["outcome"]) == ("FAILED", "error")
    assert "Traceback" in (artifacts(failed) / "error.txt").read_text()
    assert {path.name for path in artifacts(failed).glob("refused/*")} == kept
    (folder / MENDED).touch()
    assert trial(fault) == 1
    assert "Did not succeed after 4 hardware experiments" in capsys.readouterr().out
    assert (only_run().info.status, only_run().data.tags["outcome"]) == ("FINISHED", "not succeeded")
    assert "error" not in only_run().data.tags
    assert not (artifacts(only_run()) / "error.txt").exists()
    assert {path.name for path in artifacts(only_run()).glob("refused/*")} == kept
    assert not (folder / "journals").exists()


def test_what_is_refused_is_kept_each_time(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert [trial("NaN"), trial("NaN")] == [1, 1]
    err = capsys.readouterr().err
    (journal,) = (folder / "journals" / "simbias").iterdir()
    for number, line in enumerate(err.splitlines()):
        assert f"; it is kept in {journal}/refused_000{number}.npz and .txt (" in line
        with np.load(journal / f"refused_000{number}.npz") as file:
            assert np.isnan(file["states"]).sum() == 1
            assert (file["inputs"].shape, file["asked_start"].shape) == ((200, 1), (6,))
            assert np.isfinite(file["asked_parameters"]).all()
        assert "expected finite numbers" in (journal / f"refused_000{number}.txt").read_text()


def test_without_a_store_the_traceback_is_a_temporary_file(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    assert trial("zero division", "tracking=none") == 1
    match = re.search(r"\(nothing is kept; traceback in (.*); go on", capsys.readouterr().err)
    assert match is not None
    assert "1 / 0" in Path(match[1]).read_text()


def test_a_hardware_that_hangs_is_stopped(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("simbias.lab.checked_hardware.STOP_SECONDS", 0.5)
    begun = time.monotonic()
    assert trial("hangs", "experiment_timeout=0.5") == 1
    assert time.monotonic() - begun < 20
    line = capsys.readouterr().err
    assert "Faulty.run: expected an end within 0.5 s (experiment_timeout), got none" in line
    assert "(1 hardware experiment kept; " in line
    assert (folder / "stopped").exists()
    assert only_run().info.status == "FAILED"
    (folder / MENDED).touch()
    assert trial("hangs", "experiment_timeout=60") == 1  # another limit makes no other trial
    assert "Did not succeed after 4 hardware experiments" in capsys.readouterr().out
    assert only_run().info.status == "FINISHED"


def test_a_sweep_goes_on_whatever_its_hardware_does(folder: Path) -> None:
    """A cell for each fault, those that end the process too; mended, the same command goes on.

    Nobody waits for what they leave behind.
    """
    raised = ["speechless", "no UTF-8", "exit", "cancelled", "own words"]
    returned = ["list", "columns", "ended early", "NaN"]
    fine = ["float32", "none", *LEFT]
    faults = [*raised, *returned, *DEADLY, "hangs", *fine]
    write_sweep(folder, "mine", SWEEP.format(faults=", ".join(f'"{fault}"' for fault in faults)))
    command = ["--config-dir", "conf", "+sweep=mine", "hardware=faulty", "experiment_timeout=2"]
    status, out, err = run(*command, folder=folder)
    assert status == 1, out + err
    assert "Traceback" not in err  # loky tells where a worker's memory was hurt
    for fault in faults:
        (line,) = re.findall(rf"^\[\d+/{len(faults)}\] {re.escape(fault)} #0: (.*)$", out, re.MULTILINE)
        if fault in fine:
            assert line.startswith("not succeeded after 2 experiments")
        elif fault in DEADLY:
            assert line.startswith("its worker died 3 times"), line
        elif fault != "own words":
            assert line.startswith("HardwareError: Faulty.run: "), (fault, line)
            assert "expected" in line or fault == "ended early"
    assert out.count("(traceback in ") == len([*raised, *returned, "hangs"])
    (parent,), trials = runs(folder)
    assert parent.info.status == "FAILED"
    states = {run.data.tags["axis.hardware.fault"]: run.info.status for run in trials}
    assert states == {fault: "FINISHED" if fault in fine else "FAILED" for fault in faults}
    assert len(list((folder / "journals").glob("*/*/refused_0000.npz"))) == len(returned)
    (folder / MENDED).touch()
    status, out, err = run(*command, "engine=sequential", folder=folder)
    assert (status, err) == (0, ""), out + err
    (parent,), trials = runs(folder)
    assert {run.info.status for run in (parent, *trials)} == {"FINISHED"}
    assert len(trials) == len(faults)
    assert not [run for run in trials if (artifacts(run) / "error.txt").exists()]
    assert sum((artifacts(run) / "refused" / "refused_0000.npz").exists() for run in trials) == len(returned)
    assert not (folder / "journals").exists()


@pytest.mark.parametrize(("fault", "expected"), {"_exit": 7, "SIGSEGV": -11, "SIGKILL": -9}.items())
def test_a_trial_whose_process_ends_goes_on(
    folder: Path, capsys: pytest.CaptureFixture[str], fault: str, expected: int
) -> None:
    command = ["--config-dir", "conf", *SHORT, NO_PICTURES, f"hardware.fault={fault}"]
    status, _, _ = run(*command, folder=folder)
    assert status == expected
    assert len(list((folder / "journals").glob("*/*/*_experiment.npz"))) == 1
    (folder / MENDED).touch()
    assert trial(fault) == 1
    out, err = capsys.readouterr()
    assert err == ""
    assert "Did not succeed after 4 hardware experiments" in out
    assert only_run().info.status == "FINISHED"
    assert not (folder / "journals").exists()
