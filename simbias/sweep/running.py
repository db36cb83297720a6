"""Running a sweep: trials without an outcome in their folder are run, then figures are made."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from pandas import DataFrame

from simbias.config import ConfigError, Variations
from simbias.config.build import build, service
from simbias.config.sent_code import packed
from simbias.core.interruption import Interruption, deferred
from simbias.core.messages import counted
from simbias.engine.contract import Engine, WorkerLostError
from simbias.engine.workplace import tidy
from simbias.sweep.figure import UndrawnError
from simbias.sweep.grid import Sweep, Trial, expanded
from simbias.sweep.making import SweepObserver, make_figures
from simbias.sweep.state import SweepState, finished
from simbias.sweep.tracking import Tracking
from simbias.sweep.worker import PlannedTrial, Result, lost, run_plan
from simbias.testing.rehearsal import rehearse
from simbias.trial.disk import LOCK, LOOK_SECONDS, locked
from simbias.trial.folder import TrialFolder
from simbias.trial.origin import changed_code
from simbias.trial.policy_test import NO_TEST
from simbias.trial.study import Study
from simbias.trial.summary import Outcome

NOT_CONCURRENT = (
    "several trials would use {0} at the same time, in processes that may be killed without its stop(): use "
    "engine=sequential (or, if {0} is a simulation, set its attribute concurrent = True)"
)

OF_TESTS = ("success_rate", "reliable", "holds", "long_success_rate")  # measures of the last policies' tests


def run(
    overrides: Sequence[str],
    config_dir: Path | str | None = None,
    observer: SweepObserver | None = None,
    allow: Sequence[str] = (),
) -> DataFrame:
    """Compose a sweep and run its missing trials; see `run_sweep`.

    With `sweep.dry_run=true` nothing runs, and the finished trials are returned. A ConfigError reports an
    invalid sweep before anything runs.
    """
    variations = Variations(overrides, config_dir, allow)
    composition = variations.composition({})
    if "sweep" not in composition.config:
        raise ConfigError("sweep", "missing: +sweep=NAME names one")
    trials_engine: Engine = service(composition, "engine", Engine)
    store: Tracking = service(composition, "tracking", Tracking)
    sweep, ended = prepare(store, variations, trials_engine)
    if sweep.dry_run:
        return ended
    own = {"config_dir": config_dir and str(config_dir), "allow": list(allow)}
    named = "".join(f", {name}={value!r}" for name, value in own.items() if value)
    again = f"simbias.run_sweep({list(overrides)!r}{named})"
    return run_sweep(sweep, trials_engine, store, again, observer)[0]


def prepare(store: Tracking, variations: Variations, trials_engine: Engine) -> tuple[Sweep, DataFrame]:
    """The sweep, and its finished trials.

    Checks that the components of every cell can be built and that its method accepts them; a ConfigError says
    why not. If trials are to be run, the engine is checked, and the simulation is compiled.
    """
    sweep = expanded(variations)
    ended = finished(sweep, store)
    tested = any(ended["test_episodes"])  # whether any last policy was or will be tested
    studies: dict[tuple[str, ...], tuple[str, Study]] = {}
    for cell in sweep.cells:
        where = f" (in the cell {' '.join(cell.labels)})" if cell.labels else ""
        try:
            study = build(cell.composition)
            study.check()
            if study.conditions.confirm:
                raise ConfigError("hardware.confirm", "must be false: a sweep cannot ask for confirmation")
        except ConfigError as error:
            raise ConfigError("", f"{error}{where}") from error
        tested |= study.policy_test.episodes > 0
        studies.setdefault(tuple(sorted(cell.composition.choices.values())), (where, study))
    if sweep.figures_to is not None:
        _check_folder(Path(sweep.figures_to).resolve())
    for name, figure in sweep.figures.items():
        if store.folder is None and figure.reads_trials:
            raise ConfigError("tracking", f"none keeps no trials, but sweep.figures.{name} needs them")
        if figure.reads_tests and not tested:
            problem = f"is 0, but sweep.figures.{name} shows tests of the last policies"
            raise ConfigError("policy_test.episodes", problem)
    if not tested and (of_tests := [name for name in sweep.report.measures if name in OF_TESTS]):
        raise ConfigError("policy_test.episodes", f"is 0, but sweep.report.measures has {of_tests[0]}")
    if len(ended) < len(sweep.trials) and not sweep.dry_run:
        for where, study in studies.values():
            if trials_engine.has_workers and not study.hardware.concurrent:
                raise ConfigError("engine", NOT_CONCURRENT.format(type(study.hardware).__name__))
            try:
                rehearse(study)  # compiled here once; workers find it in the cache
            except ConfigError as error:
                raise ConfigError("", f"{error}{where}") from error
    return sweep, ended


def _check_folder(path: Path) -> None:
    """Refuse a place for copies of figures in which no folder can be written."""
    there = next(each for each in (path, *path.parents) if each.exists())
    if not there.is_dir():
        raise ConfigError("sweep.figures_to", f"{there} is not a folder")
    if not os.access(there, os.W_OK):
        raise ConfigError("sweep.figures_to", f"{there} cannot be written")


def run_sweep(
    sweep: Sweep,
    trials_engine: Engine,
    store: Tracking,
    again: str,
    observer: SweepObserver | None = None,
) -> tuple[DataFrame, str]:
    """Run the trials that have not ended, and make the figures; `again` is the command that resumes.

    Figures are made once no trial waits for an experiment's result or for another process, unless all raised
    an error. If only a part of the trials in the sweep's folder is run, no figures are made, and that folder
    stays unchanged.

    Returns the trials, as in `simbias.sweep.results`, and how a person can view them.

    Raises
    ------
    ConfigError
        If the store cannot be used, or another process runs this sweep.
    KeyboardInterrupt
        On a signal (`Interruption`), between two trials; finished ones are kept.
    UndrawnError
        If a figure cannot be drawn; the error has what would have been returned.
    """
    observer = observer or SweepObserver()
    folder = store.sweep_folder(sweep.name, sweep.hash)
    taken = ConfigError("sweep", "another process is running this sweep")
    with locked(folder.path / LOCK, LOOK_SECONDS, taken):
        tidy()  # an engine without workers creates no folder, which would do this
        state = SweepState(sweep, store, again)
        try:
            with Interruption():
                observer.begun(sweep, state.finished, store.folder)
                try:
                    state.begin()
                    for trial, result in _results(trials_engine, state):
                        with deferred():
                            state.keep(trial, result)
                            observer.ended(trial, result)
                finally:
                    observer.all_ended()
                undrawn = make_figures(sweep, trials_engine, state, observer) if state.draws else []
        except BaseException as error:
            state.close(error)
            raise
        state.close(*undrawn[:1])
        if undrawn:
            raise UndrawnError(undrawn, state.results(), state.export.where) from undrawn[0]
        return state.results(), state.export.where


def _results(trials_engine: Engine, state: SweepState) -> Iterator[tuple[Trial, Result]]:
    """Trials with their results, as they end; those run by another process are retried at the end."""
    taken: list[Trial] = []
    for trial, result in _tried(state.missing, trials_engine, state):
        if result.summary.outcome is Outcome.RUNNING:
            taken.append(trial)
        else:
            yield trial, result
    if taken:
        yield from _tried(taken, trials_engine, state)


def _tried(
    trials: Sequence[Trial], trials_engine: Engine, state: SweepState
) -> Iterator[tuple[Trial, Result]]:
    """Trials with the results of running them, as they end."""
    plans = _Plans(trials, partial(state.plan, shares_disk=trials_engine.shares_disk))
    cells = {trial.cell.composition.group_hash: trial.cell.composition for trial in trials}
    code = partial(packed, list(cells.values()))
    with closing(trials_engine.run(run_plan, plans, code)) as ended:
        for index, result in ended:
            result = lost(str(result)) if isinstance(result, WorkerLostError) else result
            yield trials[index], state.taken_in(trials[index], result)


class _Plans(Sequence[PlannedTrial]):
    """Planned trials for workers, each with the state of its folder when the engine takes it."""

    def __init__(self, trials: Sequence[Trial], plan: Callable[[Trial], PlannedTrial]) -> None:
        self._trials, self._plan = trials, plan

    def __len__(self) -> int:
        return len(self._trials)

    def __getitem__(self, index: Any) -> Any:
        return self._plan(self._trials[index])


def changed_trials(sweep: Sweep, store: Tracking) -> Iterator[str]:
    """Lines on trials whose user code or, if finished, test settings differ from the current ones."""
    if store.folder is None:
        return
    studies: dict[str, Study] = {}
    changed, resumed, otherwise, finished = list[str](), list[str](), 0, 0
    for trial in sweep.trials:
        folder = TrialFolder(store.folder / trial.hash)
        ended = folder.ended
        if not ended and not folder.all_steps():
            continue
        if (cell := trial.cell.composition.group_hash) not in studies:
            studies[cell] = build(trial.composition)
        with suppress(ConfigError):  # a damaged folder is reported when its trial is run
            if modules := changed_code(folder, studies[cell]):
                (changed if ended else resumed).append(modules)
        if ended:
            finished += 1
            before, asked = folder.description(), studies[cell].policy_test
            test = asdict(NO_TEST) | before["config"].get("policy_test", {})
            otherwise += asked.episodes > 0 and test != asdict(asked)
    if resumed:
        begun = counted(len(resumed), "unfinished trial")
        yield f"{begun} will resume with code or files that have changed since ({resumed[0]})"
    problems = {f"ran on code or files that have changed since ({''.join(changed[:1])})": len(changed)}
    problems["were not tested as policy_test now asks"] = otherwise
    for problem, count in problems.items():
        if count:
            yield f"{count} of {finished} finished trials {problem}; tracking.trials=FOLDER starts afresh"
