"""The test of a trial's last policy: held-out episodes on the hardware.

A trial succeeds by a few experiments of a few seconds, which its policy may pass by luck. After its end, its
last policy is therefore tested. The starts are the same in every trial of a task, for any seed. Test episodes
are not experiments of the trial, and change nothing in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from simbias.core import Task
from simbias.core.proportions import counted_share
from simbias.core.ranges import CountOrZero, Seconds, Seed
from simbias.core.records import Array

if TYPE_CHECKING:
    from simbias.trial.study import Study


@dataclass(frozen=True)
class PolicyTest:
    """Test episodes of a trial's last policy, after the trial's end."""

    episodes: CountOrZero = 0
    long_episodes: CountOrZero = 2  # of these, the number that last longer than the task's horizon,
    long_seconds: Seconds = 60.0  # namely this long
    seed: Seed = 2015  # of starts and noise; independent of trials' seeds


NO_TEST = PolicyTest()


class Episode(NamedTuple):
    """One run of a policy on the hardware."""

    start: Array  # (n,)
    asked_seconds: float  # requested duration
    seconds: float  # actual duration
    failure: str | None
    succeeds: bool | None = None  # by the task; None: lasting for the task's horizon counts, at any cost
    errors: Sequence[float] = ()  # (g,) root mean square error of each goal quantity, while it lasted
    uptime: float = np.nan  # share of the requested duration in which the conditions of success hold


@dataclass(frozen=True, eq=False)
class PolicyTestResult:
    """The test episodes of a policy; the long ones come first."""

    horizon: float  # s, the task's
    episodes: tuple[Episode, ...]

    @property
    def successes(self) -> str:
        """1 for each episode that succeeds (that lasts, if the task defines no success), 0 for each other."""
        return "".join(str(int(self._succeeds(episode))) for episode in self.episodes)

    def _succeeds(self, episode: Episode) -> bool:
        """Whether an episode is a success."""
        return self._holds(episode) if episode.succeeds is None else episode.succeeds

    @property
    def holding(self) -> str:
        """1 for each episode that lasts as long as an experiment, as in a claim, 0 for each other."""
        return "".join(str(int(self._holds(episode))) for episode in self.episodes)

    def _holds(self, episode: Episode) -> bool:
        """Whether an episode lasts as long as an experiment."""
        return episode.failure is None or episode.seconds > self.horizon

    @property
    def lasting(self) -> str:
        """1 for each episode that lasts to its own end, 0 for each other."""
        return "".join(str(int(episode.failure is None)) for episode in self.episodes)

    @property
    def success_rate(self) -> float:
        """Share of episodes that succeed."""
        return float(np.mean([each == "1" for each in self.successes]))

    @property
    def _usual(self) -> tuple[Episode, ...]:
        """The episodes that are not longer than the task's horizon."""
        return tuple(episode for episode in self.episodes if episode.asked_seconds <= self.horizon)

    @property
    def long_episodes(self) -> tuple[Episode, ...]:
        """The episodes that are longer than the task's horizon."""
        return tuple(episode for episode in self.episodes if episode.asked_seconds > self.horizon)

    @property
    def long_success_rate(self) -> float:
        """Share of long episodes in which the policy lasts to their end; nan without any."""
        return float(np.mean([float(each.failure is None) for each in self.long_episodes] or [np.nan]))

    @property
    def long_seconds(self) -> float:
        """Mean duration of the long episodes; nan without any."""
        return float(np.mean([each.seconds for each in self.long_episodes] or [np.nan]))

    @property
    def uptime(self) -> float:
        """Mean uptime of the episodes, without long ones if there are others; nan without conditions."""
        return float(np.mean([each.uptime for each in self._usual or self.episodes]))

    @property
    def words(self) -> str:
        """The result in one sentence."""
        of_usual = f" in {self.horizon:g} s" * (0 < len(self.long_episodes) < len(self.episodes))
        uptime = "" if np.isnan(self.uptime) else f"; mean uptime {self.uptime:.0%}{of_usual}"
        succeeded = counted_share(self.successes.count("1"), len(self.episodes))
        lasting, count = all(each.succeeds is None for each in self.episodes), len(self.long_episodes)
        does = "lasts without a failure" if lasting else "succeeds"
        said = f"Its last policy {does} in {succeeded} test episodes"
        if not count:
            return f"{said} of {self.horizon:g} s{uptime}."
        lasted = counted_share(sum(each.failure is None for each in self.long_episodes), count)
        long = f"{self.long_episodes[0].asked_seconds:g} s"
        of = f" of {self.horizon:g} s"
        if not lasting:  # success is decided at an episode's own end
            parts = ((self._usual, of), (self.long_episodes, f" of {long}"))
            each = (f"{s[1:]}: {sum(map(self._succeeds, some))} of {len(some)}" for some, s in parts if some)
            of = f" ({'; '.join(each)})"
        average = f"they last {self.long_seconds:.0f} s on average"
        return f"{said}{of}, and lasts in {lasted} of {long} ({average}){uptime}."


def run_policy_test(
    study: Study,
    theta: Array,
    test: PolicyTest,
    trying: Callable[[int, int], None] = lambda number, count: None,
) -> PolicyTestResult | None:
    """Run the test episodes of theta (p,); None if the test has none.

    `trying` is called before each episode, with its number and the total number. Errors are those of
    experiments.
    """
    if not test.episodes:
        return None
    task = study.task
    frames = task.frames(test.long_seconds)
    longer = study.with_horizon(frames) if test.long_episodes and frames > task.horizon else study
    episodes = []
    for number, rng in enumerate(np.random.default_rng(test.seed).spawn(test.episodes)):
        own, start = longer if number < test.long_episodes else study, task.draw_start(rng)
        trying(number, test.episodes)
        with own.checked_hardware.whole():
            rollout = own.checked_hardware.run(own.policy, np.asarray(theta, dtype=np.float64), start, rng)
        asked, lasted = own.task.horizon * task.time_step, rollout.frames * task.time_step
        succeeds = own.task.succeeds(rollout.states)
        succeeds = None if succeeds is None else succeeds and rollout.failure is None
        times = task.time_step * np.arange(len(rollout.states))
        errors = np.sqrt(np.mean(np.square(own.task.error(rollout.states, times)), axis=0))
        uptime = own.task.uptime(rollout.states)
        episodes.append(Episode(start, asked, lasted, rollout.failure, succeeds, errors.tolist(), uptime))
    return PolicyTestResult(task.horizon * task.time_step, tuple(episodes))


def episodes_csv(result: PolicyTestResult, task: Task) -> str:
    """A row for each episode: its start, requested and actual duration, failure, success, errors, uptime.

    Success is 1 or 0. Errors are root mean squares of each goal quantity. If the task states no conditions of
    success, there is no uptime.
    """
    import pandas as pd  # lazily: workers do not need it

    ended = ("asked_seconds", "lasted_seconds", "failure", "succeeded")
    errors = (f"{goal.name}_rms_error" for goal in task.goals)
    names = [*(state.name for state in task.states), *ended, *errors]
    rows = [
        (*e.start.tolist(), e.asked_seconds, e.seconds, e.failure or "", succeeded, *e.errors)
        for e, succeeded in zip(result.episodes, result.successes, strict=True)
    ]
    table = pd.DataFrame(rows, columns=names)
    if not np.isnan(result.uptime):
        table["uptime"] = [each.uptime for each in result.episodes]
    return table.to_csv(index=False, float_format="%.6g", lineterminator="\n")
