"""The pictures of stored trials: at a trial's end, in a sweep, and from its folder."""

from collections.abc import Sequence
from contextlib import chdir
from pathlib import Path

import pytest
from conftest import OWN_CONF, POINT_MASS
from matplotlib.figure import Figure
from PIL import Image
from sweeping import NO_FIGURES, QUICK

from simbias.__main__ import main as simbias
from simbias.core.records import Iteration
from simbias.pictures.trial.gallery import FIGURES
from simbias.trial.study import Study

TINY = ["--config-dir", str(OWN_CONF), *POINT_MASS, "optimizer.max_evaluations=40", "method.max_iterations=2"]

AT_REST = FIGURES.keys() - {"following"}  # of a task whose goal does not move

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """One figure is drawn, the others are empty; `test_gallery.py` draws all."""
    for name in AT_REST - {"overview"}:
        monkeypatch.setitem(FIGURES, name, empty)


def empty(study: Study, iterations: Sequence[Iteration]) -> Figure:
    return Figure(figsize=(1.0, 1.0))


def trial_of(folder: Path) -> Path:
    """The folder of a trial of a point mass."""
    with chdir(folder):
        assert simbias([*TINY, "tracking=folders"]) in (0, 1)
    (outcome,) = folder.glob("trials/*/outcome.json")
    return outcome.parent


def pictures_of(trial: Path) -> set[str]:
    return {path.name for path in (trial / "pictures").glob("*")}


@pytest.mark.usefixtures("uncompiled")
def test_command_line_draws_a_stored_trial(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As PNG and SVG; an error is one line."""
    trial, folder = trial_of(tmp_path), tmp_path / "pictures" / "new"
    assert pictures_of(trial) == {f"{name}.png" for name in AT_REST}
    capsys.readouterr()
    own = ["--config-dir", str(OWN_CONF)]
    assert simbias(["pictures", str(trial), str(folder), *own]) == 0
    names = {f"{name}{suffix}" for name in AT_REST for suffix in (".png", ".svg", ".pdf")}
    assert {path.name for path in folder.iterdir()} == names
    assert all(path.read_bytes().startswith(b"<?xml") for path in folder.glob("*.svg"))
    assert Image.open(folder / "overview.png").width == 1800  # as a README needs it
    assert (folder / "overview.png").stat().st_size < 200_000
    assert "overview.png, overview.svg, overview.pdf, " in capsys.readouterr().out
    (tmp_path / "file").touch()
    assert simbias(["pictures", str(trial), str(tmp_path / "file"), *own]) == 2
    slow, err = capsys.readouterr().err.splitlines()  # nothing is compiled in these tests, which a line says
    assert slow.startswith("simbias: simulated in NumPy")
    assert err.startswith(f"simbias: {tmp_path / 'file'}: no folder")


def test_a_sweeps_trials_keep_few_pictures(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An overview of the first of each cell; to draw one takes longer than to keep a trial."""
    monkeypatch.setitem(FIGURES, "overview", empty)
    few = ["tracking=folders", "sweep.trials=2", "engine=sequential"]
    assert simbias(["+sweep=smoke", NO_FIGURES, *QUICK, *few]) == 0
    drawn = [pictures_of(outcome.parent) for outcome in folder.glob("trials/*/outcome.json")]
    assert drawn.count({"overview.png"}) == drawn.count(set()) == len(drawn) / 2


@pytest.mark.usefixtures("uncompiled")
def test_broken_pictures_lose_no_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(study: Study, iterations: Sequence[Iteration]) -> Figure:
        raise IndexError("no such panel")

    monkeypatch.setitem(FIGURES, "overview", broken)
    with pytest.warns(RuntimeWarning, match="picture overview: IndexError"):
        trial = trial_of(tmp_path)
    assert "no such panel" in (trial / "pictures" / "overview.txt").read_text()
    assert pictures_of(trial) == {"overview.txt", *(f"{name}.png" for name in AT_REST - {"overview"})}
