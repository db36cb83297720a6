"""Making the figures of a sweep: missing experiments are run and kept, then figures are drawn and kept."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.config.sent_code import packed
from simbias.core import HardwareError, Waiting
from simbias.core.errors import ConfigError
from simbias.core.interruption import deferred
from simbias.core.messages import with_type
from simbias.engine.contract import Engine, WorkerLostError
from simbias.engine.workplace import temporary_folder
from simbias.pictures.elements.drawing import NoPictureError
from simbias.sweep.batches import Batch, Outcomes, run_batch
from simbias.sweep.figure import FigureError
from simbias.sweep.tables import left_out

if TYPE_CHECKING:
    from pandas import DataFrame

    from simbias.sweep.grid import Sweep, Trial
    from simbias.sweep.state import SweepState
    from simbias.sweep.worker import Result

EXPECTED = FigureError, NoPictureError, HardwareError, Waiting  # errors that need no traceback


class SweepObserver:
    """Follows a sweep; the base class does nothing."""

    def begun(self, sweep: Sweep, finished: DataFrame, folder: Path | None) -> None:
        """The unfinished trials begin; they are kept in the folder, if there is one."""

    def ended(self, trial: Trial, result: Result) -> None:
        """A trial has ended or stopped, and is kept."""

    def all_ended(self) -> None:
        """No trial runs any more, for any reason."""

    @contextmanager
    def working(self, words: str, total: int, done: int) -> Iterator[Callable[[], None]]:
        """Work of `total` steps, some already done; the yielded function is called after each step."""
        yield lambda: None

    def drawn(self, name: str, caption: str, files: Sequence[Path]) -> None:
        """A figure is drawn and kept; `files` are the copies in the user's folder, if there is one."""


def make_figures(
    sweep: Sweep,
    engine: Engine,
    state: SweepState,
    observer: SweepObserver,
) -> list[FigureError]:
    """Make every figure that the sweep declares; return the errors of those that cannot be made."""
    undrawn: list[FigureError] = []
    for name, figure in sweep.figures.items():
        try:
            trials = state.swept()
            batches = figure.experiments(trials)
            outcomes = _outcomes(name, batches, engine, state, observer)
            picture = figure.draw(trials, outcomes)
            caption = picture.caption + left_out(trials.table["outcome"])
            picture = replace(picture, caption=caption)
            with temporary_folder() as folder, deferred():
                files = picture.write(Path(folder), name)
                state.publish(name, caption, files)
                observer.drawn(name, caption, _copy(files, sweep.figures_to))
        except ConfigError:  # the sweep has to stop
            raise
        except Exception as error:
            hardware = "hardware: " * isinstance(error, HardwareError | Waiting)
            words = str(error) if isinstance(error, EXPECTED) else with_type(error)
            undrawn.append(FigureError(f"{name}: {hardware}{words}"))
            undrawn[-1].__cause__ = error
    return undrawn


def _outcomes(
    name: str,
    batches: Sequence[Batch],
    engine: Engine,
    state: SweepState,
    observer: SweepObserver,
) -> list[Outcomes]:
    """The outcomes of all batches; stored ones are not run again."""
    batch_of = {batch.hash: batch for batch in batches}
    outcomes = state.folder.outcomes(list(batch_of))
    missing = [identity for identity in batch_of if identity not in outcomes]
    if missing:
        tasks = [batch_of[identity] for identity in missing]
        code = partial(packed, [task.composition for task in tasks])
        with (
            observer.working(f"{name}: batches of experiments", len(batch_of), len(outcomes)) as advance,
            closing(engine.run(run_batch, tasks, code)) as results,
        ):
            for index, result in results:
                if isinstance(result, WorkerLostError) or result.error:
                    raise FigureError(str(getattr(result, "error", result)))
                with deferred():
                    outcomes[missing[index]] = result
                    state.folder.keep_outcomes(missing[index], result)
                    advance()
    return [outcomes[batch.hash] for batch in batches]


def _copy(files: Sequence[Path], folder: str | None) -> list[Path]:
    """Copy the files to the user's folder, if there is one."""
    if folder is None:
        return []
    Path(folder).mkdir(parents=True, exist_ok=True)
    return [Path(shutil.copy(file, folder)) for file in files]
