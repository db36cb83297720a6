"""Making figures: errors say of which, and what is kept of their experiments is text."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import simbias
from simbias.core import HardwareError, Waiting
from simbias.core.interruption import Interruption
from simbias.engine.sequential import Sequential
from simbias.pictures.elements.drawing import NoPictureError
from simbias.robots.bongoboard.pymunk import PymunkBongoboard
from simbias.sweep.batches import Batch, Outcomes
from simbias.sweep.figure import FigureError, Picture, SweepFigure, SweptTrials
from simbias.sweep.figures.success_rates import Range, SuccessRates
from simbias.sweep.folder import SweepFolder
from simbias.sweep.grid import expand
from simbias.sweep.making import SweepObserver, make_figures
from simbias.trial.study import Study

FALLING = np.array([8.118, 4.731, -6.740, -1.024, -4.0])
STARTS = np.zeros((2, 6))


class Store:
    """The state of a sweep, as far as figures need it."""

    def __init__(self, path: Path) -> None:
        path.mkdir(exist_ok=True)
        self.folder = SweepFolder(path)

    @property
    def kept(self) -> list[Outcomes]:
        return [Outcomes.from_json(file.read_text()) for file in self.folder.path.glob("experiments/*")]

    def swept(self) -> Any:
        return SimpleNamespace(table=pd.DataFrame({"outcome": ["succeeded", "error", "error"]}))

    def publish(self, name: str, caption: str, files: Sequence[Path]) -> None:
        assert all(file.exists() for file in files)
        assert caption == "Frames. 2 trials raised an error and are left out."


class Tries(SweepFigure):
    """A figure that tries a policy on hardware."""

    def __init__(self, study: Study, seeds: int) -> None:
        self._batches = [Batch(study.composition, FALLING, STARTS, seed) for seed in range(seeds)]

    def experiments(self, trials: SweptTrials) -> Sequence[Batch]:
        return self._batches

    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        return Picture(
            Figure(), pd.DataFrame({"frames": [outcome.frames[0] for outcome in outcomes]}), "Frames."
        )


def test_a_published_picture_is_whole_at_any_time(tmp_path: Path) -> None:
    """A new one takes the old one's place and is not written into it."""
    folder, file = SweepFolder(tmp_path), tmp_path / "costs.md"
    published = tmp_path / "figures" / "costs.md"
    file.write_text("old")
    folder.publish([file])
    with published.open() as old:
        file.write_text("new")
        folder.publish([file])
        assert (old.read(), published.read_text()) == ("old", "new")


@pytest.fixture(scope="module")
def brief() -> Study:
    return simbias.load(["task.horizon=50"])


def make(figure: SweepFigure, store: Store, folder: Path) -> list[str]:
    """The errors of making a figure."""
    sweep = SimpleNamespace(figures={"tries": figure}, figures_to=str(folder))
    with Interruption():
        return [*map(str, make_figures(sweep, Sequential(), store, SweepObserver()))]


def test_errors_name_the_figure(brief: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the hardware among its experiments, and those of drawing; nothing is kept of what failed."""
    broken, closed = HardwareError("a leg broke"), Waiting("the lab is closed until Monday")
    for owner, method, error, message in (
        (PymunkBongoboard, "run", broken, "hardware: a leg broke"),
        (PymunkBongoboard, "run", closed, "hardware: the lab is closed until Monday"),
        (Tries, "draw", NoPictureError("nothing to see"), "nothing to see"),
        (Tries, "draw", closed, "hardware: the lab is closed until Monday"),
        (Tries, "draw", KeyError("x"), "KeyError: 'x'"),
    ):
        store = Store(tmp_path / "sweep")
        figure = Tries(brief, int(owner is PymunkBongoboard))
        with monkeypatch.context() as patch:
            patch.setattr(owner, method, Mock(side_effect=error))
            assert make(figure, store, tmp_path) == [f"tries: {message}"]
        assert not store.kept
    assert make(Tries(brief, 2), store, tmp_path) == []
    assert {outcome.successes for outcome in store.kept} == {(True, True)}


@pytest.mark.slow
def test_hardware_without_starts_has_no_grid_of_them(brief: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = expand(["+sweep=fig7"])
    x, y = Range("alpha_w", -0.1, 0.1, 2), Range("alpha_b", -0.1, 0.1, 2)
    figure = SuccessRates(brief.task, sweep.cells, x, y, 1, "learned with noise")
    monkeypatch.setattr(PymunkBongoboard, "sets_start", False)
    with pytest.raises(FigureError, match="pymunk begins where it stands"):
        figure.experiments(SweptTrials(sweep, pd.DataFrame(), lambda _: None))
