"""A trial in the terminal: running, resuming or replaying it; its exit status."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from simbias.config import Composition, ConfigError
from simbias.config.build import build, service
from simbias.config.stored import read_folder
from simbias.core import Model, Policy
from simbias.core.commands import BAD_INPUT, FAILED, SUCCEEDED, WAITING
from simbias.core.messages import LONGEST_REASON, brief, counted, with_type
from simbias.core.records import Array, Iteration, Rollout, Search
from simbias.engine.contract import Engine
from simbias.engine.workplace import tidy
from simbias.lab.checked_hardware import ask
from simbias.sweep.tracking import Export, Tracking
from simbias.terminal.lines import say, standard_output, temporary_traceback
from simbias.terminal.notices import preparing
from simbias.testing.rehearsal import rehearse
from simbias.trial import continuation, diagnostics
from simbias.trial.diagnostics import Remark
from simbias.trial.folder import TRIAL, TrialFolder
from simbias.trial.model_selection import WINDOW
from simbias.trial.observer import Observer, Observers
from simbias.trial.origin import changed_code
from simbias.trial.prediction import predict
from simbias.trial.run import TrialRecord, run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome, TrialSummary

SMALL = 0.1  # cost below which three decimals may hide it
CONTINUE = "To continue from these experiments, raise method.max_iterations or budget, and add {} {}."


def run(
    composition: Composition,
    again: str,
    earlier: Path | None = None,
    config_dir: str | None = None,
    allow: Sequence[str] = (),
) -> int:
    """Run or resume one trial; `again` is the command that does so.

    It begins with the steps of the trial in the folder `earlier`, if given. That one's own code is found as
    for `simbias.load_trial`.
    """
    service(composition, "engine", Engine)  # a single trial needs no engine, but an invalid one is bad input
    tidy()  # a finished trial creates no folder, which would do this
    store: Tracking = service(composition, "tracking", Tracking)
    with preparing():
        study = build(composition)
        rehearse(study)
        folder = store.trial_folder(study.hash)
        if earlier and folder is None:
            raise ConfigError(continuation.OPTION, "nothing would be kept with tracking=none")
        if earlier and folder:
            reading = partial(read_folder, config_dir=config_dir, allow=allow)
            continuation.continue_trial(study, folder, earlier, reading)
    return _run_study(study, folder, store, again)


def _run_study(study: Study, folder: Path | None, store: Tracking, again: str) -> int:
    """Run, resume or replay a trial as far as possible; without a folder, nothing is kept."""
    export = store.export_trial(folder) if folder else Export()
    replayed = folder is not None and _ended(TrialFolder(folder))
    if folder is not None and (changed := changed_since(study, folder)):
        print(f"simbias: {changed}", file=sys.stderr)
    try:
        with TrialConsole(study) as console:
            asking = replace(study.conditions, ask=console.ask)  # if confirmation is required
            record = run_trial(replace(study, conditions=asking), folder, Observers(console, export))
        if folder is not None and store.pictures:
            from simbias.pictures.trial.gallery import illustrate  # lazily: not everyone needs Matplotlib

            illustrate(record, folder)
    except (ConfigError, KeyboardInterrupt):
        raise
    except Exception as error:  # from the disk: errors of components are in the record
        print(f"simbias: {with_type(error)} (resume with:  {again})", file=sys.stderr)
        return FAILED
    finally:
        export.update(final=True)
    summary = record.summary
    if summary.outcome.final:
        console.conclude(record, export.where, replayed)
        limited = study.config["method"].get("max_iterations") == study.method.max_iterations
        if folder and limited and summary.outcome is Outcome.NOT_SUCCEEDED:
            print(CONTINUE.format(continuation.OPTION, folder))
        return SUCCEEDED if summary.outcome is Outcome.SUCCEEDED else FAILED
    kept = f"{counted(summary.experiments, 'hardware experiment')} kept" if folder else "nothing is kept"
    if summary.outcome is Outcome.ERROR and not record.traceback:  # a bad key or file; see the reason
        print(f"simbias: {summary.reason} ({kept})", file=sys.stderr)
        return BAD_INPUT
    trace = f"; traceback in {file}" if (file := traceback_file(summary, record.traceback)) else ""
    print(f"simbias: {summary.reason} ({kept}{trace}; resume with:  {again})", file=sys.stderr)
    return WAITING if summary.outcome is Outcome.WAITING else FAILED


def _ended(folder: TrialFolder) -> bool:
    """Whether a trial has ended; an unreadable outcome is reported, as it is made anew."""
    try:
        folder.summary()
    except ConfigError as error:
        print(f"simbias: {error}", file=sys.stderr)
    return folder.ended


def cost_text(cost: float) -> str:
    """A cost in at most eight characters, if it is positive."""
    if 0 < abs(cost) < SMALL:
        return f"{cost:#.3g}"
    return f"{cost:.3f}" if cost < 1000 else f"{cost:.2e}".replace("e+0", "e")


class TrialConsole(Observer):
    """A row for every iteration, and a progress bar while a search runs on a terminal."""

    def __init__(self, study: Study, console: Console | None = None) -> None:
        self._study = study
        self._console = console or standard_output(soft_wrap=True)  # also the output of hardware
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[best]}"),
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
            disable=not self._console.is_terminal,
        )
        self._bar = self._progress.add_task("policy search", total=study.optimizer.max_evaluations, best="")
        self._experiments = 0
        self._iterations: list[Iteration] = []
        self._model: Model | None = None
        self._said: set[str] = set()  # kinds of remarks
        self._said_of_policy: set[str] = set()  # kinds of remarks on the last policy
        self._width = (26 if study.task.says_success else 18) * (
            study.method.max_experiments // study.method.max_iterations
        )

    def __enter__(self) -> TrialConsole:
        study = self._study
        say(self._console, brief(study.title), "bold")
        say(self._console, f"seed {study.seed}, trial {study.hash}\n")
        cost = f"{'cost on hardware (lasted)':<{self._width}}"
        say(self._console, f"{'':>3}  {'predicted':>9}  {cost}  {'data':>5}  {'seconds':>7}", "dim")
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def searching(self, evaluations: int, best_cost: float) -> None:
        """Update the progress bar of the policy search."""
        self._progress.update(
            self._bar,
            description="policy search",
            completed=min(evaluations, self._study.optimizer.max_evaluations),
            best=f"best {cost_text(best_cost)}",
        )

    def designed(self, theta: Array, model: Model | None = None, search: Search | None = None) -> None:
        """Report oddities of a policy, before hardware is spent on it."""
        self._said_of_policy.clear()
        self._remark(diagnostics.of_policy(theta, model, search, self._iterations))
        self._remark(diagnostics.of_prediction(theta, model, self._study), again=True)
        self._model = model

    def _remark(self, remarks: Iterable[Remark], again: bool = False) -> None:
        """Print remarks between the lines of iterations, with the iteration's number, repeats in brief.

        A remark on a policy is not repeated, for example for its second start.
        """
        number = f"{len(self._iterations):>3}"
        for remark in remarks:
            if remark.kind not in self._said:
                say(self._console, f"{number}  {brief(remark.words, LONGEST_REASON)}", "yellow")
            elif again and remark.kind not in self._said_of_policy:
                say(self._console, f"{number}  again: {remark.kind}", "yellow")
            self._said.add(remark.kind)
            self._said_of_policy.add(remark.kind)

    def experimenting(self, theta: Array, start: Array) -> None:
        """Report that a hardware experiment is running; meanwhile, the screen belongs to the hardware."""
        self._remark(diagnostics.of_safety(theta, start, self._model, self._study), again=True)
        words = f"hardware experiment {self._experiments + 1} under way"
        self._progress.update(self._bar, description=words, completed=0, best="")

    def ask(self, policy: Policy, theta: Array, start: Array, horizon: int) -> bool:
        """Show the prediction of an experiment, and ask whether it may be run, while the screen is still."""
        from simbias.terminal.preview import describe

        self._progress.stop()
        task, cost, model = self._study.task, self._study.cost, self._model
        if horizon != task.horizon:  # of a long test episode
            task = task.with_horizon(horizon)
            with suppress(NotImplementedError):  # then its cost is that of the task's horizon
                cost = cost.with_horizon(horizon)
        study = replace(self._study, task=task, cost=cost, policy=policy)
        bias, nominal = (model.bias, model.nominal) if model else (None, None)
        bounds = study.conditions.safety.bounds(study.task)
        for line in describe(study, predict(study, theta, start, bias, nominal), bounds):
            say(self._console, line)
        allowed = ask(policy, theta, start, horizon)
        self._progress.start()
        return allowed

    def experimented(self, rollout: Rollout) -> None:
        """Report a hardware experiment that has ended."""
        self._experiments += 1
        self._progress.update(self._bar, description=f"hardware experiment {self._experiments} done")

    def trying(self, number: int, count: int) -> None:
        """Report that a test episode is running."""
        words = f"test episode {number + 1} of {count}"
        self._progress.update(self._bar, description=words)

    def iterated(self, iteration: Iteration) -> None:
        """Print one line for an iteration."""
        self._progress.update(self._bar, description="policy search", completed=0, best="", refresh=True)
        search, learning = iteration.search, iteration.learning
        predicted = cost_text(search.predicted_cost) if search else ""
        samples = str(len(learning.data)) if learning else ""
        experiments = "  ".join(self._experiment_text(rollout) for rollout in iteration.experiments)
        notes = "  [yellow]model cleared[/yellow]" if learning and learning.reset else ""
        line = f"{iteration.index:>3}  {predicted:>9}  {experiments:<{self._width}}  {samples:>5}"
        say(self._console, f"{line}  {sum(iteration.seconds.values()):>7.1f}{notes}", markup=True)
        if learning and learning.log_likelihoods:
            say(self._console, f"     {likelihoods_text(learning.log_likelihoods)}")
        self._remark(diagnostics.of_inputs(iteration.experiments, self._study), again=True)
        self._remark(diagnostics.of_reset(iteration, self._study.cost.max_cost))
        if learning and not iteration.succeeded:
            self._remark(diagnostics.of_selection(learning.selection))
        self._iterations.append(iteration)

    def _experiment_text(self, rollout: Rollout, of_policy: bool = True) -> str:
        """Cost and duration of an experiment, and whether it is no success if its cost does not show this."""
        study, word = self._study, "missed" if rollout.failed_at is None else "failed"
        by_cost = not study.task.says_success and rollout.cost >= study.cost.max_cost
        hidden = of_policy and not by_cost and not study.passes(rollout)
        seconds = rollout.frames * study.task.time_step
        return f"{cost_text(rollout.cost):>8} ({seconds:.2f} s{f', {word}' * hidden})"

    def conclude(self, record: TrialRecord, where: str, replayed: bool = False) -> None:
        """Print the closing line: the outcome, the number of experiments, and how to view the trial."""
        summary = record.summary
        colour = "green" if summary.outcome is Outcome.SUCCEEDED else "red"
        self._progress.update(self._bar, visible=False)
        why = f" {escape(brief(summary.reason))}" if summary.reason else ""
        earlier = ", in an earlier run of this command; seed=N starts another trial" * replayed
        verdict = f"[{colour}]{summary.outcome.verdict}[/{colour}] after {summary.effort}{earlier}.{why}"
        say(self._console, f"\n{verdict}", markup=True)
        for withdrawal in record.withdrawn:
            say(self._console, f"{withdrawal}.", "yellow")
        for finding in summary.findings:
            say(self._console, finding)
        method, first = record.study.method, not record.iterations
        whats = "Random experiments", "Experiments of an unfinished iteration"
        for what, made in zip(whats, method.split(record.unfinished, first), strict=True):
            if made:
                texts = (self._experiment_text(each, of_policy=what != whats[0]) for each in made)
                say(self._console, f"{what}: {'  '.join(texts).strip()}.")
        if where:
            say(self._console, f"Look at it:  {where}")


def changed_since(study: Study, folder: Path) -> str:
    """The user's modules and files that changed since a folder's trial began, in a line; "" if none."""
    if not (folder / TRIAL).exists() or not (modules := changed_code(TrialFolder(folder), study)):
        return ""
    what = "is shown as it was; its" if TrialFolder(folder).ended else "resumes, but its"
    return f"the trial {what} code or files have changed since it began ({modules}); seed=N starts a new one"


def traceback_file(summary: TrialSummary, traceback: str) -> str:
    """The file with a traceback: in the trial's folder, else a new temporary one; "" without a traceback."""
    return summary.traceback_file or (temporary_traceback(traceback) if traceback else "")


def likelihoods_text(likelihoods: Mapping[str, float]) -> str:
    """The log-likelihoods of the model variants, and the variant used for the next search."""
    values = ", ".join(f"{name} {value:.1f}" for name, value in likelihoods.items())
    best = max(likelihoods, key=lambda name: likelihoods[name])
    return f"held-out log-likelihood of {1000 * WINDOW:g} ms: {values}; continues with {best}"
