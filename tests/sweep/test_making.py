"""Making figures: what they need is run once and kept, whoever looks on; errors say of which figure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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
from simbias.sweep.figure import FigureError, SweepFigure, SweptTrials
from simbias.sweep.figures.success_rates import Range, SuccessRates
from simbias.sweep.folder import SweepFolder
from simbias.sweep.grid import expand
from simbias.sweep.making import FigureObserver, make_figures
from simbias.sweep.picture import Picture
from simbias.trial.study import Study

FALLING = np.array([8.118, 4.731, -6.740, -1.024, -4.0])
STARTS = np.zeros((2, 6))


class Store:
    """The state of a sweep, as far as figures need it."""

    def __init__(self, path: Path) -> None:
        path.mkdir(exist_ok=True)
        self.folder = SweepFolder(path)
        self.captions: dict[str, str] = {}

    @property
    def kept(self) -> list[Outcomes]:
        return [Outcomes.from_json(file.read_text()) for file in self.folder.path.glob("experiments/*")]

    def swept(self) -> Any:
        return None

    def publish(self, name: str, caption: str, files: Sequence[Path]) -> None:
        assert all(file.exists() for file in files)
        self.captions[name] = caption


class Notes(FigureObserver):
    """What there was to hear of."""

    def __init__(self) -> None:
        self.lines: list[Any] = []

    @contextmanager
    def working(self, words: str, total: int, done: int) -> Iterator[Any]:
        self.lines.append((words, total, done))
        yield lambda: self.lines.append("step")

    def drawn(self, name: str, caption: str, files: Sequence[Path]) -> None:
        self.lines.append((name, caption, [file.name for file in files]))


class Tries(SweepFigure):
    """A figure that tries a policy on hardware."""

    def __init__(self, study: Study, seeds: int) -> None:
        self._batches = [Batch.of(study.composition, FALLING, STARTS, seed) for seed in range(seeds)]

    def experiments(self, trials: SweptTrials) -> Sequence[Batch]:
        return self._batches

    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        numbers = pd.DataFrame({"frames": [outcome.frames[0] for outcome in outcomes]})
        return Picture(Figure(), numbers, f"{len(outcomes)} batches.")


@pytest.fixture(scope="module")
def brief() -> Study:
    return simbias.load(["task.horizon=50"])


def make(figure: SweepFigure, store: Store, observer: FigureObserver, folder: Path) -> None:
    sweep = SimpleNamespace(figures={"tries": figure}, figures_to=str(folder))
    with Interruption() as interruption:
        make_figures(sweep, Sequential(), store, observer, interruption)


def test_batches_are_run_once_and_kept(brief: Study, tmp_path: Path) -> None:
    store, notes = Store(tmp_path / "sweep"), Notes()
    make(Tries(brief, 1), store, FigureObserver(), tmp_path)
    assert len(store.kept) == 1
    make(Tries(brief, 3), store, notes, tmp_path)
    files = ["tries.png", "tries.svg", "tries.csv", "tries.md"]
    progress = ("tries: batches of experiments", 3, 1)
    assert notes.lines == [progress, "step", "step", ("tries", "3 batches.", files)]
    assert len(store.kept) == 3
    assert {outcome.successes for outcome in store.kept} == {(True, True)}
    assert store.captions == {"tries": "3 batches."}


def test_errors_name_the_figure(brief: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the hardware among its experiments, and those of drawing; nothing is kept of what failed."""

    broken, closed = HardwareError("a leg broke"), Waiting("the lab is closed until Monday")
    for owner, method, error, message in (
        (PymunkBongoboard, "run", broken, "hardware: a leg broke"),
        (PymunkBongoboard, "run", closed, "hardware: the lab is closed until Monday"),
        (Tries, "draw", NoPictureError("nothing to see"), "nothing to see"),
        (Tries, "draw", closed, "hardware: the lab is closed until Monday"),
    ):
        store = Store(tmp_path / "sweep")
        figure = Tries(brief, int(owner is PymunkBongoboard))
        with monkeypatch.context() as patch:
            patch.setattr(owner, method, Mock(side_effect=error))
            with pytest.raises(FigureError) as raised:
                make(figure, store, FigureObserver(), tmp_path)
        assert str(raised.value) == f"tries: {message}"
        assert not store.kept


def test_outcomes_travel_as_text() -> None:
    outcomes = Outcomes((0.1 + 0.2, 1e300), (5000, 17), ("", "speed"), (True, False))
    text = outcomes.as_json()
    assert Outcomes.from_json(text) == outcomes
    for bad in ("", text[:20], text[:-1], '{"costs": [1.0], "frames": [17]}', "3"):
        with pytest.raises(ValueError, match=r"not the outcomes|line 1"):
            Outcomes.from_json(bad)


def test_hardware_without_starts_has_no_grid_of_them(brief: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = expand(["+sweep=fig7"])
    x, y = Range("alpha_w", -0.1, 0.1, 2), Range("alpha_b", -0.1, 0.1, 2)
    figure = SuccessRates(brief.task, sweep.cells, x, y, 1, "learned with noise")
    monkeypatch.setattr(PymunkBongoboard, "sets_start", False)
    with pytest.raises(FigureError, match="pymunk begins where it stands"):
        figure.experiments(SweptTrials(sweep, pd.DataFrame(), lambda _: None))
