"""What a policy is worth: tried on the hardware from starts that no one learned from.

A trial succeeds with a few experiments of a few seconds, which its policy may pass by luck. So after its end
its last policy is tried: from starts that are the same in every trial of a task, whatever the seed. These
tries are kept apart. They are no experiments of the trial, nothing is learned from them, and they change
nothing in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from simbias.core.records import Array
from simbias.trial.study import HeldOut, Study

SEED = 2015  # of the starts and of the noise from there: its own, which no trial's seed touches


class Try(NamedTuple):
    """A policy, tried from one start."""

    start: Array  # (n,)
    asked: float  # s
    seconds: float  # s that it lasted
    failure: str | None


@dataclass(frozen=True, eq=False)
class Tries:
    """A policy, tried from held-out starts."""

    horizon: float  # s, the task's
    each: tuple[Try, ...]  # those that go on come first

    @property
    def holds(self) -> tuple[bool, ...]:
        """From which starts it lasts for the task's horizon."""
        return tuple(one.seconds >= self.horizon or one.failure is None for one in self.each)

    @property
    def held(self) -> float:
        """The share of starts from which it does."""
        return float(np.mean(self.holds))

    @property
    def going_on(self) -> tuple[Try, ...]:
        """Those that were to last longer."""
        return tuple(one for one in self.each if one.asked > self.horizon)

    @property
    def lasted(self) -> float:
        """The share of these that did; nan without any."""
        return float(np.mean([float(one.failure is None) for one in self.going_on] or [np.nan]))

    @property
    def seconds(self) -> float:
        """The mean time of these until they fell, or were ended; nan without any."""
        return float(np.mean([one.seconds for one in self.going_on] or [np.nan]))

    @property
    def words(self) -> str:
        """What came out, in one sentence."""
        held = f"Its last policy holds {sum(self.holds)} of {len(self.each)} held-out starts"
        if not self.going_on:
            return f"{held} for {self.horizon:g} s."
        lasted = sum(one.failure is None for one in self.going_on)
        return (
            f"{held} for {self.horizon:g} s, and {lasted} of {len(self.going_on)} for "
            f"{self.going_on[0].asked:g} s ({self.seconds:.0f} s on average)."
        )


def try_policy(
    study: Study,
    theta: Array,
    held_out: HeldOut,
    trying: Callable[[int, int], None] = lambda number, count: None,
) -> Tries | None:
    """Try theta (p,) on the hardware from held-out starts; None if none is asked for.

    `trying` hears of each try before it begins: its number, and how many there are.

    Raises
    ------
    HardwareError, Waiting
        As of an experiment.
    """
    if not held_out.starts:
        return None
    task = study.task
    horizons = _horizons(study, held_out)
    studies = {
        horizon: study if horizon == task.horizon else study.with_horizon(horizon)
        for horizon in set(horizons)
    }
    each = []
    for number, rng in enumerate(np.random.default_rng(SEED).spawn(held_out.starts)):
        own, start = studies[horizons[number]], task.draw_start(rng)
        trying(number, held_out.starts)
        rollout = own.conducted.run(own.policy, np.asarray(theta, dtype=np.float64), start, rng)
        asked, lasted = own.task.horizon * task.time_step, rollout.frames * task.time_step
        each.append(Try(start, asked, lasted, rollout.failure))
    return Tries(task.horizon * task.time_step, tuple(each))


def _horizons(study: Study, held_out: HeldOut) -> Sequence[int]:
    """The frames of every try."""
    lasting = max(study.task.frames(held_out.seconds), study.task.horizon)
    return [lasting if number < held_out.lasting else study.task.horizon for number in range(held_out.starts)]
