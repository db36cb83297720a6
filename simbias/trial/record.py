"""The steps of a trial in its folder: replayed as far as they go, then appended."""

from __future__ import annotations

import itertools
import json
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from simbias.core import Task, platform
from simbias.core.errors import ConfigError
from simbias.core.messages import words
from simbias.core.records import Array, Iteration, Optimum, Rollout
from simbias.lab.checked_hardware import MakeExperiment, place_of
from simbias.lab.checks import check_rollout
from simbias.lab.requests.folder import POLICY, WITHDRAWN
from simbias.trial.disk import append_line, loaded, read_json, room_for, write_json, write_whole
from simbias.trial.files import largest, load_rollout, packed_rollout, raw_json
from simbias.trial.folder import (
    ATTEMPTS,
    EPISODE,
    EPISODES,
    EXPERIMENT,
    ITERATION,
    OUTCOME,
    SEARCH,
    TRIAL,
    TrialFolder,
    kind_of,
)
from simbias.trial.origin import description, digests, tell_what_is_in_clear
from simbias.trial.replay import EndOfRecord, Record
from simbias.trial.step_files import StepFiles, changed, missing
from simbias.trial.study import Study
from simbias.trial.summary import TrialSummary, iteration_summary

ERROR, REFUSED = "error_", "refused_"
ROUNDING = 1e-6  # allowed difference of a computed policy, such as LQR, between platforms
COMPARED = ("iteration", "total_experiments", "succeeded")  # between an iteration and its replay
SHARED = "simbias: %s was made for another trial, before this one began; it counts in both"
ELSEWHERE = "simbias: %s: its answer %s was withdrawn in another trial; if it is bad, withdraw it here, too"
MIXED = "simbias: trial %s mixes platforms, so its last bits match neither: %s; now %s"


class FolderRecord(Record):
    """The steps of a trial in its folder: replayed as far as they go, then appended if it is opened."""

    def __init__(self, path: Path, study: Study) -> None:
        self.folder = TrialFolder(path)
        self._study = study
        self._steps = StepFiles(self.folder)
        self._episodes = 0  # number replayed
        self._replayed_seconds = 0.0  # duration of the replayed iterations
        self._searched = 0.0  # duration in s of the searches replayed since the last iteration
        self.testing = False  # whether the last policy's test runs, whose episodes are not experiments

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Lock the folder for this process, and write into it, unless the trial has ended.

        ConfigError if the folder cannot be written, belongs to another trial, or holds steps or an outcome
        without a readable trial.json; or if another process runs this trial.
        """
        with nullcontext() if self.folder.ended else self.folder.held():
            if not self.folder.ended:  # another process may have ended it meanwhile
                self._begin()
            else:
                self.folder.check_identity(self._study.hash)
            yield

    def _begin(self) -> None:
        """Write trial.json before the first step, and record the start of an attempt."""
        path = self.folder.path
        there, other = self._steps.begin(), {}
        if (path / TRIAL).exists():
            self.folder.check_identity(self._study.hash)
            if (code := digests(self._study)) != self.folder.description().get("code", {}):
                other = {"code": code}
        elif there or self.folder.numbered(OUTCOME).exists():
            raise missing(path / TRIAL)
        else:
            tell_what_is_in_clear(self._study.composition.from_environment, path / TRIAL)
            write_json(path / TRIAL, description(self._study))
        here, before = platform.kind(), self.folder.platforms()
        if self.folder.steps() and before and here not in before:  # read before this attempt's line is added
            logging.getLogger(__name__).warning(MIXED, path.name, before[-1], here)
        attempt = {"started": time.time(), "platform": here, "processor": platform.processor(), **other}
        append_line(path / ATTEMPTS, attempt)

    def search(self, make: Callable[[], Optimum]) -> Optimum:
        """The next search."""
        path = self._replayed(SEARCH)
        if path is not None:
            optimum, seconds = loaded(path, _load_search)
            self._searched += seconds
            return optimum
        begun = time.perf_counter()
        optimum = make()
        seconds = time.perf_counter() - begun
        fields = {**asdict(optimum), "parameters": optimum.parameters.tolist(), "seconds": seconds}
        self._steps.append(SEARCH, json.dumps(fields).encode())
        return optimum

    def experiment(self, theta: Array, rng: np.random.Generator, make: MakeExperiment) -> Rollout:
        """The next experiment; one that breaks the contract is no step, as it would be replayed forever."""
        kind = EPISODE if self.testing else EXPERIMENT
        path, place = self._replayed(kind, EXPERIMENT), place_of(rng)  # episodes were also called so at first
        if path is not None:
            rollout, own = loaded(path, self._experiment)
            if own != place or not self._fits(rollout, theta):
                raise changed(path)
            self._episodes += self.testing
            if rollout.source and Path(rollout.source).with_name(WITHDRAWN).exists():
                logging.getLogger(__name__).warning(ELSEWHERE, path, rollout.source)
            return rollout
        superseded, withdrawn = self._former(kind, theta, place)
        file = self._steps.next(kind)
        with room_for(file, largest(self._longest_task, theta, place)):
            rollout = superseded or make(another(rng, withdrawn))
            for asked in Path(rollout.source).parent.glob(POLICY) if rollout.source else ():
                if asked.stat().st_mtime < self.folder.began:
                    logging.getLogger(__name__).warning(SHARED, rollout.source)
            self._steps.write(file, packed_rollout(rollout, place))
        return rollout

    @property
    def _longest_task(self) -> Task:
        """The task; in a test, with the horizon of its longest episodes."""
        task, seconds = self._study.task, self._study.policy_test.long_seconds
        return task.with_horizon(max(task.horizon, task.frames(seconds))) if self.testing else task

    def _fits(self, rollout: Rollout, theta: Array) -> bool:
        """Whether an experiment used theta (p,): to the last bit if the trial ran on this platform only."""
        kept = rollout.parameters
        if np.array_equal(kept, theta):
            return True
        elsewhere = kept.shape == theta.shape and self.folder.platforms() != [platform.kind()]
        return elsewhere and np.allclose(kept, theta, rtol=ROUNDING, atol=ROUNDING)

    def _experiment(self, path: Path) -> tuple[Rollout, tuple[int, ...]]:
        """Load an experiment and its place, and check it as a rollout; test episodes may be longer."""
        rollout, place = load_rollout(path)
        check_rollout(rollout, "it", self._study.task.with_horizon(max(1, rollout.frames)))
        return rollout, place

    def _former(self, kind: str, theta: Array, place: tuple[int, ...]) -> tuple[Rollout | None, int]:
        """The superseded step with theta (p,) in this place, if any, and the number of withdrawn ones."""
        withdrawn = {each.experiment for each in self.folder.withdrawals()}
        latest, count = None, 0
        for file in self.folder.all_steps() if withdrawn and place else ():
            if file.name.endswith(kind):
                rollout, own = loaded(file, self._experiment)
                if own == place and np.array_equal(rollout.parameters, theta):
                    latest = None if file.name in withdrawn else rollout
                    count += file.name in withdrawn
        return latest, count

    def iteration(self, iteration: Iteration, earlier: Sequence[Iteration]) -> Iteration:
        """Record a finished iteration; if it is replayed, with its recorded durations and predicted cost."""
        path = self._replayed(ITERATION)
        if path is None:
            seconds = dict(iteration.seconds)
            if "search" in seconds:
                seconds["search"] += self._searched  # replayed searches take no time
            told = {name: taken for name, taken in seconds.items() if not np.isnan(taken)}
            iteration = replace(iteration, seconds=told)
            summary = {**iteration_summary(self._study, iteration, earlier), "ended": time.time()}
            text = json.dumps(summary, indent=1, default=lambda value: value.tolist())  # NumPy's numbers
            self._steps.append(ITERATION, text.encode())
        else:
            kept, seconds, predicted = loaded(path, _load_iteration)
            if kept != (iteration.index, iteration.total_experiments, iteration.succeeded):
                raise changed(path)
            search = iteration.search
            if search is not None and predicted is not None:
                search = replace(search, predicted_cost=predicted)
            iteration = replace(iteration, search=search, seconds=seconds)
            self._replayed_seconds += sum(seconds.values())
        self._searched = 0.0
        return iteration

    @property
    def seconds_before(self) -> float:
        """Wall time in s of the earlier attempts; for a killed one, that of its iterations."""
        return max(self.folder.seconds(), self._replayed_seconds)

    def refuse(self, returned: Any, theta: Array, start: Array, why: str) -> str:
        """Keep an invalid result beside the steps; failing to keep it must not hide the original error."""
        try:
            texts = {"why": why, "parameters": theta, "start": start, "returned": returned}
            files = (self.folder.path / f"{REFUSED}{number:04d}.json" for number in itertools.count())
            path = next(file for file in files if not file.exists())
            parts = (f"{json.dumps(name)}: {raw_json(part)}" for name, part in texts.items())
            write_whole(path, ("{" + ",\n".join(parts) + "}\n").encode())
        except Exception as error:
            return f"; it could not be kept ({words(error)})"
        return f"; it is kept in {path}"

    def traceback(self, text: str) -> str:
        """Keep an attempt's traceback; return its file, or "" if it cannot be written."""
        count = sum("started" in each for each in self.folder.attempts())
        file = self.folder.path / f"{ERROR}{max(0, count - 1):04d}.txt"
        try:
            write_whole(file, text.encode())
        except OSError:  # it must not hide the original error
            return ""
        return str(file)

    def stop(self, summary: TrialSummary, episodes: str | None = None) -> None:
        """Record how the trial ended, or how this attempt stopped; `episodes` is the test's CSV.

        For a trial that had already ended, only this CSV is written, if it differs and the test is the same.
        """
        ended = None if self._steps.writes else self.folder.summary()
        if episodes is not None and (ended is None or ended.test_words == summary.test_words):
            file, content = self.folder.numbered(EPISODES), episodes.encode()
            if not file.is_file() or file.read_bytes() != content:
                write_whole(file, content)
        if not self._steps.writes:
            return
        if summary.outcome.final:
            write_json(self.folder.numbered(OUTCOME), summary.as_json())
        else:
            append_line(self.folder.path / ATTEMPTS, {"stopped": summary.as_json()})

    def summary(self, replayed: TrialSummary) -> TrialSummary | None:
        """How the trial ended or stopped, according to its folder.

        ConfigError if it cannot be read, or its counts differ from those of the replayed steps.
        """
        summary = self.folder.summary()
        if summary is not None and summary.outcome.final:
            said, made = ((each.experiments, each.iterations) for each in (summary, replayed))
            if said != made:
                problem = "counts {} experiments and {} iterations, its steps {} and {}".format(*said, *made)
                remedy = "Delete it: running its trial again recreates it from the steps"
                raise ConfigError(str(self.folder.numbered(OUTCOME)), f"{problem}. {remedy}")
        return summary

    def check_end(self) -> None:
        """Raise a ConfigError if steps are left after the trial's end, except episodes of another test."""
        left = [step for step in self._steps.left if not step.name.endswith(EPISODE)]
        ended = self.folder.summary() if left and self.folder.ended else None
        former = len(ended.test_episodes) - self._episodes if ended else 0  # formerly named experiments
        if len(left) > max(0, former):
            raise changed(left[0])

    def _replayed(self, *kinds: str) -> Path | None:
        """The next step, if there is one; EndOfRecord if there is none, and the trial is only being read.

        ConfigError if it is of another kind, since the trial's code has changed; or if there is none although
        the trial has ended, since somebody has removed it.
        """
        step = next(self._steps.left, None)
        if step is None and not self._steps.writes:
            ended = self.folder.summary() if self.folder.ended else None
            if ended is not None and not (self.testing and self._episodes >= len(ended.test_episodes)):
                raise missing(self._steps.path(kinds[0]))
            raise EndOfRecord
        if step is not None and kind_of(step) not in kinds:
            raise changed(step)
        return step

    def check(self) -> None:
        """Compare the folder with what this process has read and written (`StepFiles`)."""
        self._steps.check()


def another(rng: np.random.Generator, times: int) -> np.random.Generator:
    """A generator for the same place, with new random numbers for a repeated experiment."""
    seed = rng.bit_generator.seed_seq
    if not times or not isinstance(seed, np.random.SeedSequence):
        return rng
    entropy = [times, *seed.generate_state(4).tolist()]
    return np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=seed.spawn_key))


def _load_iteration(path: Path) -> tuple[tuple[Any, ...], dict[str, float], float | None]:
    """An iteration's fields to compare with its replay, its seconds, and its predicted cost, if any."""
    fields = read_json(path)
    return itemgetter(*COMPARED)(fields), fields["seconds"], fields.get("predicted_cost")


def _load_search(path: Path) -> tuple[Optimum, float]:
    """The optimum of a search, and its duration in seconds; nan if its file has none."""
    fields = {"seconds": np.nan, **read_json(path)}
    seconds = fields.pop("seconds")
    return Optimum(**{**fields, "parameters": np.array(fields["parameters"])}), seconds
