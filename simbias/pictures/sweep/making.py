"""Making the figures of a sweep: what they still need is run and kept, then they are drawn and kept."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from simbias.interfaces import Engine, TrackedSweep, WorkerLostError
from simbias.pictures.sweep.batches import Batch, Outcomes, run_batch
from simbias.pictures.sweep.swept import FigureError, SweptTrials
from simbias.sweep.grid import Sweep
from simbias.sweep.interruption import Interruption, stopping_workers
from simbias.terminal.sweep import SweepConsole


def make_figures(
    sweep: Sweep, engine: Engine, tracked: TrackedSweep, console: SweepConsole, interruption: Interruption
) -> None:
    """Make every figure that the sweep declares.

    Raises
    ------
    FigureError
        If one cannot be drawn from what there is.
    KeyboardInterrupt
        On SIGINT or SIGTERM; what has ended is kept.
    """
    for name, figure in sweep.figures.items():
        trials = SweptTrials(sweep, tracked.results(), tracked.load)
        batches = figure.experiments(trials)
        picture = figure.draw(trials, _outcomes(name, batches, engine, tracked, console, interruption))
        with tempfile.TemporaryDirectory() as folder, interruption.deferred():
            files = picture.write(Path(folder), name)
            tracked.publish(name, picture.caption, files)
            console.drawn(name, picture.caption, _copied(files, sweep.figures_to))


def _outcomes(
    name: str,
    batches: Sequence[Batch],
    engine: Engine,
    tracked: TrackedSweep,
    console: SweepConsole,
    interruption: Interruption,
) -> list[Outcomes]:
    """The outcomes of all batches; those that are kept are not run again."""
    planned = {batch.hash: batch for batch in batches}
    found = tracked.outcomes(list(planned))
    missing = [identity for identity in planned if identity not in found]
    if missing:
        with (
            console.working(f"{name}: batches of experiments", len(planned), len(found)) as advance,
            stopping_workers(engine.run(run_batch, [planned[identity] for identity in missing])) as results,
        ):
            for index, result in results:
                if isinstance(result, WorkerLostError) or result.error:
                    raise FigureError(f"{name}: {getattr(result, 'error', result)}")
                with interruption.deferred():
                    found[missing[index]] = result
                    tracked.keep_outcomes(missing[index], result)
                    advance()
    return [found[batch.hash] for batch in batches]


def _copied(files: Sequence[Path], folder: str | None) -> list[Path]:
    """The files in a folder of the user's, if there is one."""
    if folder is None:
        return []
    Path(folder).mkdir(parents=True, exist_ok=True)
    return [Path(shutil.copy(file, folder)) for file in files]
