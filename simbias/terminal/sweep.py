"""A sweep in the terminal: running or listing its missing trials; its exit status."""

from __future__ import annotations

import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from statistics import mean

from pandas import DataFrame
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from simbias.config import Composition, ConfigError, Variations
from simbias.config.build import service
from simbias.core.commands import FAILED, INTERRUPTED, SUCCEEDED, WAITING
from simbias.core.messages import brief, counted
from simbias.engine.contract import Engine, EngineLostError
from simbias.mlflow.store import cause
from simbias.sweep import running
from simbias.sweep.figure import UndrawnError
from simbias.sweep.grid import Sweep, Trial
from simbias.sweep.making import EXPECTED
from simbias.sweep.running import SweepObserver
from simbias.sweep.tables import BLANK, Layout, arrange, cells, layout, legend, plain
from simbias.sweep.tracking import Tracking
from simbias.sweep.worker import Result
from simbias.terminal.lines import place_of_trace, say, standard_output
from simbias.terminal.notices import preparing
from simbias.terminal.trial import traceback_file
from simbias.trial.folder import TrialFolder
from simbias.trial.summary import Outcome

SHOWN_ERRORS = 5


def run(variations: Variations, composition: Composition, again: str) -> int:
    """Run a sweep's missing trials, or list them (dry run); `again` is the command that runs them."""
    trials_engine: Engine = service(composition, "engine", Engine)
    store: Tracking = service(composition, "tracking", Tracking)
    with preparing():
        sweep, finished = running.prepare(store, variations, trials_engine)
    if sweep.dry_run:
        dry_run(sweep, finished, trials_engine)
        return SUCCEEDED
    console = SweepConsole()
    for changed in running.changed_trials(sweep, store):
        print(f"simbias: {changed}", file=sys.stderr)
    try:
        trials, where = running.run_sweep(sweep, trials_engine, store, again, console)
    except KeyboardInterrupt:
        console.stopped("interrupted", again)
        return INTERRUPTED
    except EngineLostError as error:
        console.stopped(str(error), again)
        return FAILED
    except UndrawnError as error:
        console.conclude(error.trials, error.where)
        for each in error.undrawn:
            trace = "" if isinstance(each.__cause__, EXPECTED) else place_of_trace(each)
            print(f"simbias: figure {each}{trace}", file=sys.stderr)
        print(f"Resume with:  {again}", file=sys.stderr, flush=True)
        return FAILED
    except ConfigError:
        raise
    except Exception as error:  # from the store or the engine: errors of trials are in their records
        console.stopped(f"{type(error).__name__}: {cause(error)}", again)
        return FAILED
    console.conclude(trials, where)
    if console.waiting or console.taken:
        return WAITING
    return FAILED if (trials["outcome"] == "error").any() else SUCCEEDED


def duration(seconds: float) -> str:
    """A duration in its largest suitable unit."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


class SweepConsole(SweepObserver):
    """A progress bar and a growing table on a terminal; otherwise a line for every trial."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or standard_output()
        self._sweep: Sweep
        self._keeps = True
        self._total = 0
        self._ran = 0  # by this process
        self._start = time.monotonic()
        self._experiments: dict[tuple[str, ...], list[float]] = defaultdict(list)
        self._figures: list[tuple[str, str, Sequence[Path]]] = []
        self._outcomes: list[str] = []
        self._diagnostics: dict[str, tuple[str, ...]] = {}  # of each trial, by hash
        self._progress = Progress(
            TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[state]}")
        )
        self._live: Live | None = None

    def begun(self, sweep: Sweep, finished: DataFrame, folder: Path | None) -> None:
        """Print what will run and how much is done, and follow it."""
        self._sweep, self._keeps, self._total = sweep, folder is not None, len(sweep.trials)
        self._outcomes = list(finished["outcome"])
        names = [axis.name for axis in sweep.axes]
        for row in finished.to_dict("records"):
            self._experiments[tuple(row[name] for name in names)].append(row["experiments"])
            if folder and (summary := TrialFolder(folder / row["hash"]).summary()):
                self._diagnostics[row["hash"]] = summary.diagnostics
        done = len(finished)
        self._bar = self._progress.add_task("", total=self._total, completed=done, state="")
        resumed = f", {done} of them finished already" if done else ""
        counts = f"{len(sweep.cells)} cells x {sweep.repetitions} trials = {self._total}"
        say(self._console, f"[bold]{escape(brief(sweep.name))}[/bold]: {counts}{resumed}", markup=True)
        if not self._keeps:
            say(self._console, "No trial is kept (tracking=none): an interrupted sweep cannot resume.")
        self._start = time.monotonic()
        if self._console.is_terminal:
            self._live = Live(get_renderable=self._view, console=self._console, refresh_per_second=2)
            self._live.start()

    def all_ended(self) -> None:
        """Leave the table in its last state."""
        if self._live is not None:
            self._live.stop()

    def ended(self, trial: Trial, result: Result) -> None:
        """Report a trial that has ended or stopped, and is kept."""
        summary = result.summary
        self._ran += 1
        self._outcomes.append(summary.outcome)
        self._diagnostics[trial.hash] = summary.diagnostics
        if summary.outcome.final:
            self._experiments[trial.cell.labels].append(summary.experiments_until_success)
        self._progress.update(self._bar, completed=len(self._outcomes), state=self._state())
        if not summary.outcome.final or not self._console.is_terminal:
            done = f"[{len(self._outcomes)}/{self._total}]"
            made = counted(summary.experiments, "experiment")
            outcome = summary.stopped_by or f"{summary.outcome} after {made}"
            few = self._outcomes.count(Outcome.ERROR) <= SHOWN_ERRORS  # few enough for a person to read
            if file := traceback_file(summary, result.traceback if few else ""):
                outcome += f" (traceback in {file})"
            line = f"{done} {trial.name}: {outcome}, {summary.seconds:.1f} s; {self._state()}"
            say(self._console, line)

    def _state(self) -> str:
        """Rate, time left and failures so far."""
        elapsed = time.monotonic() - self._start
        rate = self._ran / max(elapsed, 1e-9)
        left = f"{duration((self._total - len(self._outcomes)) / rate)} left" if self._ran else ""
        failed, raised = self._outcomes.count("not succeeded"), self._outcomes.count("error")
        counts = [f"{failed} failed" if failed else "", f"{raised} raised" if raised else ""]
        return ", ".join(filter(None, [f"{60 * rate:.1f}/min", left, *counts]))

    def _view(self) -> Group:
        """The current table, and the bar."""
        return Group(_rich(arrange(self._sweep, ["done, mean"], self._cell)), self._progress)

    def _cell(self, labels: tuple[str, ...]) -> list[str]:
        """A cell's numbers of finished trials and of all, and their mean number of experiments."""
        counts = self._experiments.get(labels, [])
        mean = f"{sum(counts) / len(counts):.1f}" if counts else BLANK
        return [f"{len(counts)}/{self._sweep.repetitions} {mean:>5}"]

    @contextmanager
    def working(self, words: str, total: int, done: int) -> Iterator[Callable[[], None]]:
        """A bar, or a line for every step; call the yielded function after each."""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=self._console, disable=not self._console.is_terminal) as progress:
            bar = progress.add_task(words, total=total, completed=done)
            steps = count(done + 1)

            def advance() -> None:
                progress.advance(bar)
                if not self._console.is_terminal:
                    say(self._console, f"[{next(steps)}/{total}] {words}")

            yield advance

    def drawn(self, name: str, caption: str, files: Sequence[Path]) -> None:
        """Note a figure and its files, to report at the end."""
        self._figures.append((name, caption, files))

    def conclude(self, trials: DataFrame, where: str) -> None:
        """Print the table, its meaning, and how to view the rest."""
        arrangement = layout(cells(trials, self._sweep), self._sweep)
        say(self._console, plain(arrangement))
        say(self._console, legend(self._sweep, trials))
        raised = [row for row in trials.to_dict("records") if row["outcome"] == Outcome.ERROR]
        for row in raised[:SHOWN_ERRORS]:
            cell = " ".join(str(row[axis.name]) for axis in self._sweep.axes)
            line = f"{cell} #{row['repetition']} (seed {row['seed']}) raised {row['raised']}"
            say(self._console, line, "red")
        if more := len(raised[SHOWN_ERRORS:]):
            say(self._console, f"and {more} more raised an error", "red")
        kinds = Counter(kind for each in trials["hash"] for kind in self._diagnostics.get(each, ()))
        for words, trials_with in sorted(kinds.items(), key=lambda item: (-item[1], item[0])):
            say(self._console, f"In {trials_with} of {counted(len(trials), 'trial')}: {words}.")
        resumes = "the same command resumes the sweep"
        for number, words in (
            (len(raised), "{} raised an error"),
            (self.waiting, "Waiting for hardware: {}"),
            (self.taken, "Another process is running {}"),
        ):
            if number:
                say(self._console, f"{words.format(counted(number, 'trial'))}; {resumes}.")
        for name, caption, files in self._figures:
            if files:
                shown = " ".join(map(str, files))
                say(self._console, f"{name}: {caption}\n  {shown}")
        if where:
            say(self._console, f"Look at it:  {where}")

    @property
    def waiting(self) -> int:
        """The number of trials waiting for an experiment's result."""
        return self._outcomes.count(Outcome.WAITING)

    @property
    def taken(self) -> int:
        """The number of trials run by another process."""
        return self._outcomes.count(Outcome.RUNNING)

    def stopped(self, why: str, again: str) -> None:
        """Report that the sweep ended early, its progress, and how to resume it."""
        done = sum(Outcome(outcome).final for outcome in self._outcomes)
        kept = f"; {done} of {self._total} trials are done" if self._total else ""  # else not yet counted
        kept += "" if self._keeps else ", but not kept"
        text = f"simbias: {' '.join(why.split())[:500]}{kept}.\nResume with:  {again}"
        print(text, file=sys.stderr, flush=True)


def _rich(arrangement: Layout) -> Table:
    """A layout as a table of the library rich."""
    table = Table(box=None, pad_edge=False)
    for head in arrangement.head:
        table.add_column(Text(head), justify="right")
    for line in arrangement.body:
        table.add_row(*map(Text, line))
    return table


def dry_run(sweep: Sweep, finished: DataFrame, engine: Engine) -> None:
    """Print how many trials of each cell are finished, and how long the others may take."""
    done = frozenset(finished["hash"])
    ended = Counter(trial.cell.labels for trial in sweep.trials if trial.hash in done)
    print(plain(arrange(sweep, ["done"], lambda labels: [f"{ended[labels]}/{sweep.repetitions}"])))
    n_jobs = getattr(engine, "n_jobs", 1)
    seconds = seconds_left(sweep, finished, n_jobs)
    how_long = "the remaining time cannot be estimated yet"
    if seconds is not None:
        how_long = f"judging by these, the others may take {duration(seconds)} on {counted(n_jobs, 'job')}"
    print(f"{sweep.name}: {len(done)} of {len(sweep.trials)} trials are finished; {how_long}.")


def seconds_left(sweep: Sweep, finished: DataFrame, n_jobs: int) -> float | None:
    """Estimated seconds for the missing trials, from the finished ones; None if none is finished.

    A trial is assumed to last as long as those of its cell or, if none of them is finished, of all cells.
    """
    if finished.empty:
        return None
    seconds: dict[tuple[str, ...], list[float]] = {}
    for row in finished.to_dict("records"):
        seconds.setdefault(tuple(row[axis.name] for axis in sweep.axes), []).append(row["seconds"])
    overall, done = list(finished["seconds"]), set(finished["hash"])
    missing = (trial for trial in sweep.trials if trial.hash not in done)
    return sum(mean(seconds.get(trial.cell.labels, overall)) for trial in missing) / n_jobs
