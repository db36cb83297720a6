"""The folder of a trial: its config and all its steps, append-only.

    trial.json              composed config, chosen options, versions, the user's own code; written first
    attempts.jsonl          a line for the continued trial, if any, and for each start, stop and withdrawal
    0000_search.json        the steps in the order in which they ended:
    0001_experiment.npz     searches, hardware experiments,
    0002_iteration.json     iterations, with all their measured numbers,
    0009_test_episode.npz   episodes of the last policy's test, if requested
    test_episodes.csv       the test as a table
    outcome.json            how the trial ended; without it, the trial has not ended
    refused_0000.json       what the hardware returned instead of a rollout
    error_0000.txt          the traceback of an attempt
    pictures/               drawn from all this; may be deleted

Running a trial again replays its steps and continues from there; reading it replays them and stops.
Everything else that shows a trial, such as a table, a picture or an MLflow run, is made from its folder.

A withdrawn experiment and the steps after it stay on disk but no longer count: the trial continues as if it
had stopped before them. After n withdrawals its outcome is `outcome_n.json`, its test `test_episodes_n.csv`.
"""

from __future__ import annotations

import re
import shutil
import time
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass
from math import nan
from pathlib import Path
from typing import Any, NamedTuple

from simbias.core.errors import ConfigError
from simbias.core.messages import counted, quote, with_type, words
from simbias.lab.requests.folder import mark_withdrawn
from simbias.trial.disk import LOCK, PART, append_line, loaded, locked, read_json, read_lines
from simbias.trial.files import load_rollout
from simbias.trial.summary import TrialSummary

TRIAL, ATTEMPTS, OUTCOME, EPISODES = "trial.json", "attempts.jsonl", "outcome.json", "test_episodes.csv"
SEARCH, EXPERIMENT, ITERATION = "search.json", "experiment.npz", "iteration.json"
EPISODE = "test_episode.npz"
STEP = re.compile(rf"[0-9]{{4,}}_({'|'.join(map(re.escape, (SEARCH, EXPERIMENT, ITERATION, EPISODE)))})")
AFTER = re.compile(r"outcome_([0-9]+)\.json")  # an outcome after this many withdrawals
CONTINUES = "continues"  # key of a first line in attempts.jsonl: the trial that this one continues
KINDS = {"started", "stopped", "withdrawn", CONTINUES}  # of lines in attempts.jsonl
PICTURES = "pictures"
REMEDY = "Running its trial again recreates it from the steps"  # the remedy for an unreadable outcome
LOCK_SECONDS = 5.0  # that a worker waits for the system to release the lock of a killed predecessor


class TakenError(ConfigError):
    """Another process is running the trial."""


@dataclass(frozen=True)
class Withdrawal:
    """An experiment that a person withdrew."""

    experiment: str  #: its file
    reason: str
    superseded: tuple[str, ...]  #: files of the steps after it
    time: float  #: s since the epoch
    seconds: float  #: wall time of the trial until then

    def __str__(self) -> str:
        return f"{self.experiment} was withdrawn{f': {self.reason}' if self.reason else ''}"


class Origin(NamedTuple):
    """An earlier trial, with the steps of which another one begins."""

    hash: str
    experiments: int  #: that counted
    seconds: float  #: its wall time
    platforms: list[str]


@dataclass(frozen=True)
class TrialFolder:
    """A trial's folder, for reading; the trial may still be running."""

    path: Path

    def description(self) -> dict[str, Any]:
        """The content of trial.json.

        Raises
        ------
        ConfigError
            If there is none, or it cannot be read.
        """
        if not (file := self.path / TRIAL).exists():
            raise ConfigError(str(self.path), f"is not the folder of a trial (it has no {TRIAL})")
        return read_json(file)

    def check_identity(self, identity: str) -> None:
        """Raise a ConfigError if this is another trial's folder, or if `description` raises one."""
        found = self.description().get("hash")
        if found != identity:
            problem = f"is the folder of trial {found}, not of trial {identity}. Move it away"
            raise ConfigError(str(self.path), problem)

    @property
    def ended(self) -> bool:
        """Whether the trial has ended; otherwise it is running, or can be resumed.

        A damaged outcome, or one beside a damaged trial.json, does not count; running the trial again
        recreates the outcome from its steps.
        """
        with suppress(ConfigError):
            summary = self.summary()
            return summary is not None and summary.outcome.final and bool(self.description())
        return False

    def summary(self) -> TrialSummary | None:
        """How the trial ended, or how its last attempt stopped; None if it runs, or was killed.

        Raises
        ------
        ConfigError
            If it cannot be read.
        """
        file, content = self.numbered(OUTCOME), None
        if not file.exists():
            file, content = self.path / ATTEMPTS, next(iter(self.attempts()[-1:]), {}).get("stopped")
            if content is None:
                return None
        try:
            return TrialSummary.from_json(read_json(file) if content is None else content)
        except (AttributeError, TypeError, ValueError) as error:
            problem = error.problem if isinstance(error, ConfigError) else f"cannot be read ({words(error)})"
            raise ConfigError(str(file), f"{problem}. {REMEDY}") from error

    def attempts(self) -> list[dict[str, Any]]:
        """The lines of attempts.jsonl; one truncated by a kill is left out, ConfigError for a damaged one."""
        lines = read_lines(self.path / ATTEMPTS)
        for line in lines:
            if not line.keys() & KINDS:
                raise ConfigError(
                    str(self.path / ATTEMPTS), f"has a line with unknown keys {quote([*line])}. Repair it"
                )
        return lines

    @property
    def began(self) -> float:
        """Start time of the first attempt, s since the epoch; nan before it."""
        return next((each["started"] for each in self.attempts() if "started" in each), nan)

    def platforms(self) -> list[str]:
        """The platforms that the trial ran on, in their order."""
        earlier = origin.platforms if (origin := self.continues) else []
        own = [each["platform"] for each in self.attempts() if "platform" in each]
        return list(dict.fromkeys([*earlier, *own]))

    @property
    def continues(self) -> Origin | None:
        """The trial that this one continues (see `continuation`), if any; ConfigError if damaged."""
        try:
            return next((Origin(**each[CONTINUES]) for each in self.attempts() if CONTINUES in each), None)
        except TypeError as error:
            raise ConfigError(str(self.path / ATTEMPTS), f"cannot be read ({with_type(error)})") from error

    def seconds(self) -> float:
        """Wall time in s of all attempts except killed ones."""
        stopped = (each.get("stopped") for each in self.attempts())
        stops = [float(each.get("seconds") or 0.0) for each in stopped if isinstance(each, dict)]
        stops += [each.seconds for each in self.withdrawals()]
        stops += [origin.seconds] if (origin := self.continues) else []
        return max(stops, default=0.0)  # each includes the attempts before it

    def withdrawals(self) -> list[Withdrawal]:
        """The experiments that a person withdrew, in the order of withdrawal.

        ConfigError if one cannot be read, or is gone although the trial has ended after it.
        """
        file = self.path / ATTEMPTS
        lines = [each["withdrawn"] for each in self.attempts() if "withdrawn" in each]
        try:
            found = [Withdrawal(**{**each, "superseded": tuple(each["superseded"])}) for each in lines]
        except (KeyError, TypeError) as error:
            raise ConfigError(str(file), f"cannot be read ({with_type(error)})") from error
        numbers = (AFTER.fullmatch(each.name) for each in self.path.glob("outcome_*"))
        for outcome in filter(None, numbers):
            if int(outcome[1]) > len(found):
                told = counted(len(found), "withdrawal")
                raise ConfigError(str(file), f"lists {told}, but {outcome[0]} exists. Restore the file")
        return found

    def numbered(self, name: str) -> Path:
        """A file of this name; if there are withdrawals, their number is part of the name."""
        count, (stem, _, suffix) = len(self.withdrawals()), name.partition(".")
        return self.path / (f"{stem}_{count}.{suffix}" if count else name)

    def all_steps(self) -> list[Path]:
        """The files of all steps, in the order in which they were made."""
        found = (file for file in self.path.glob("[0-9]*_*") if STEP.fullmatch(file.name))
        return sorted(found, key=number)

    def steps(self) -> list[Path]:
        """The files of the steps that count, in their order."""
        gone = {name for each in self.withdrawals() for name in (each.experiment, *each.superseded)}
        return [file for file in self.all_steps() if file.name not in gone]

    def iterations(self) -> list[dict[str, Any]]:
        """The finished iterations, in the format of `simbias.trial.summary.iteration_summary`."""
        return [read_json(file) for file in self.steps() if file.name.endswith(ITERATION)]

    def files(self) -> list[Path]:
        """All files except those being written."""
        found = (file for file in self.path.rglob("*") if file.is_file() and not file.name.startswith("."))
        return sorted(file for file in found if file.suffix != PART)

    @property
    def illustrated(self) -> bool:
        """Whether there are pictures, or a text that replaces them."""
        return any(file.suffix != PART for file in (self.path / PICTURES).glob("*"))

    def held(self) -> AbstractContextManager[None]:
        """Lock the folder for this process; TakenError if another holds it, ConfigError if read-only."""
        taken = TakenError(str(self.path), "another process is running this trial")
        return locked(self.path / LOCK, LOCK_SECONDS, taken)


def number(step: Path) -> int:
    """The number that the name of a step's file begins with."""
    return int(step.name.partition("_")[0])


def kind_of(step: Path) -> str:
    """The kind of step that follows the number, such as EXPERIMENT."""
    return step.name.partition("_")[2]


def step_name(number: int, kind: str) -> str:
    """The name of the file of a step."""
    return f"{number:04d}_{kind}"


def withdraw(experiment: Path, reason: str = "") -> Withdrawal:
    """Withdraw the experiment in this file of a trial's folder; even a finished trial can then be resumed.

    The resumed trial repeats the experiment. Later experiments are reused if the trial requests them again,
    with the same policy in the same place; searches are run again. If a person provided the experiment's file
    in answer to a request, no trial accepts it any more.

    Raises
    ------
    ConfigError
        If the file is not an experiment that counts, if it or trial.json cannot be read, or if a process is
        running the trial.
    """
    folder = TrialFolder(experiment.parent)
    if not (folder.path / TRIAL).exists():
        raise ConfigError(str(experiment), "is not in a trial's folder")
    folder.description()  # needed to resume the trial
    with folder.held():
        counted = [file.name for file in folder.steps()]
        experiments = [name for name in counted if name.endswith((EXPERIMENT, EPISODE))]
        if experiment.name not in experiments:
            problem = f"is not an experiment that counts; those are: {', '.join(experiments) or 'none'}"
            raise ConfigError(str(experiment), problem)
        if source := loaded(experiment, load_rollout)[0].source:
            mark_withdrawn(Path(source), f"{experiment}: {reason}")
        superseded = counted[counted.index(experiment.name) + 1 :]
        shutil.rmtree(folder.path / PICTURES, ignore_errors=True)  # they show steps that no longer count
        seconds = summary.seconds if (summary := folder.summary()) else folder.seconds()
        withdrawal = Withdrawal(experiment.name, reason, tuple(superseded), time.time(), seconds)
        append_line(folder.path / ATTEMPTS, {"withdrawn": asdict(withdrawal)})
    return withdrawal
