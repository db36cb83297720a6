"""The pictures of stored trials: at a trial's end, in a sweep, and from the store."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from conftest import OWN_CONF, POINT_MASS
from matplotlib.figure import Figure
from mlflow import MlflowClient
from mlflow.entities import Run
from sweeping import NO_FIGURES, QUICK, artifacts, runs

from simbias.__main__ import main as simbias
from simbias.core.records import Iteration
from simbias.pictures.__main__ import main as draw
from simbias.pictures.trial.gallery import FIGURES, IN_SWEEPS
from simbias.trial.study import Study

pytestmark = pytest.mark.slow

TINY = ["--config-dir", str(OWN_CONF), *POINT_MASS, "optimizer.max_evaluations=40", "method.max_iterations=2"]


def run_of(folder: Path, *overrides: str) -> Run:
    """The run of a trial of a point mass, in a store of its own."""
    uri = f"sqlite:///{folder}/mlflow.db"
    assert simbias([*TINY, f"tracking.uri={uri}", *overrides]) in (0, 1)
    client = MlflowClient(uri)
    experiment = client.get_experiment_by_name("simbias")
    assert experiment is not None
    (run,) = client.search_runs([experiment.experiment_id])
    return run


def test_command_line_draws_a_stored_trial(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All of it, as PNG and SVG; what cannot be drawn ends with one line that says why."""
    run, uri = run_of(tmp_path), f"sqlite:///{tmp_path}/mlflow.db"
    kept = {path.name for path in (artifacts(run) / "pictures").iterdir()}
    assert kept == {f"{name}.png" for name in FIGURES}
    folder = tmp_path / "pictures" / "new"
    capsys.readouterr()
    own = ["--config-dir", str(OWN_CONF)]
    assert draw([run.info.run_id, str(folder), "--uri", uri, *own]) == 0
    names = {f"{name}{suffix}" for name in FIGURES for suffix in (".png", ".svg")}
    assert {path.name for path in folder.iterdir()} == names
    assert all(path.read_bytes().startswith(b"<?xml") for path in folder.glob("*.svg"))
    assert "overview.png, overview.svg, " in capsys.readouterr().out
    for run_id, target, message in (
        ("0" * 32, tmp_path, "no such run"),
        (run.info.run_id, tmp_path / "mlflow.db", "no folder"),
    ):
        assert draw([run_id, str(target), "--uri", uri, *own]) == 2
        err = capsys.readouterr().err
        assert message in err
        assert err.count("\n") == 1


def test_trials_without_pictures(tmp_path: Path) -> None:
    run = run_of(tmp_path, "tracking.pictures=false")
    assert not (artifacts(run) / "pictures").exists()


def test_a_sweeps_trials_keep_few_pictures(tmp_path: Path) -> None:
    """The first of each cell; to draw one takes longer than to keep a trial."""
    uri = f"tracking.uri=sqlite:///{tmp_path}/mlflow.db"
    assert simbias(["+sweep=smoke", NO_FIGURES, *QUICK, uri, "sweep.trials=2", "engine=sequential"]) == 0
    for run in runs(tmp_path)[1]:
        kept = {path.name for path in (artifacts(run) / "pictures").glob("*")}
        first = run.data.tags["repetition"] == "0"
        assert kept == ({f"{name}.png" for name in IN_SWEEPS} if first else set())


def test_broken_pictures_lose_no_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(study: Study, iterations: Sequence[Iteration]) -> Figure:
        raise IndexError("no such panel")

    monkeypatch.setitem(FIGURES, "overview", broken)
    with pytest.warns(RuntimeWarning, match="picture overview: IndexError"):
        run = run_of(tmp_path)
    assert run.info.status == "FINISHED"
    assert "no such panel" in (artifacts(run) / "pictures" / "overview.txt").read_text()
