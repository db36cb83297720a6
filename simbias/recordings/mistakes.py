"""Likely mistakes in signs and columns of recordings: changes that reduce the models' errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from simbias.core import Nominal, Task
from simbias.core.records import Array, Indices, Rollout
from simbias.lab.rates import rates_of
from simbias.recordings.horizons import horizons, over_recorded

MISTAKEN = 0.9  # ratio of errors below which a change is likely correct


class Mistake(NamedTuple):
    """A change of recordings that reduces the models' errors."""

    words: str
    times: float  # errors of the nominal model, relative to those before
    recordings: Sequence[str]  # in which the change reduces errors; empty: all


class Change(NamedTuple):
    """A change of signs or order of states (n) and inputs (m)."""

    words: str
    order: Indices  # (n + m,)
    signs: Array  # (n + m,)

    def of(self, rollouts: Sequence[Rollout]) -> list[Rollout]:
        """The rollouts with this change applied."""
        n = rollouts[0].states.shape[1]
        return [
            replace(
                each,
                states=self.signs[:n] * each.states[:, self.order[:n]],
                inputs=self.signs[n:] * each.inputs[:, self.order[n:] - n],
            )
            for each in rollouts
        ]


def mistakes(
    task: Task, models: Sequence[Nominal], recordings: Mapping[str, Sequence[Rollout]]
) -> list[Mistake]:
    """Mistakes on which all models agree, most important first; the first model is the nominal one.

    If the nominal model lacks a spring, a wrong sign of an input below resonance reduces its errors, but not
    the identified model's. A detected change is kept, since a sign is wrong relative to the others.
    """
    left, found = changes(task), []
    of_each = {
        name: over_recorded(task, models[0], pieces)
        for name, pieces in recordings.items()
        if horizons(task, max(each.frames for each in pieces))
    }
    rollouts = [each for pieces in recordings.values() for each in pieces]
    errors = [over_recorded(task, model, rollouts) for model in models]
    last, last_of_each = np.ones(len(models)), dict.fromkeys(of_each, 1.0)
    while left:
        tried = [np.array([errs(each.of(rollouts)) for errs in errors]) for each in left]
        best = int(np.argmin([round(each.max(), 3) for each in tried]))  # if mirrored, the input's sign
        if tried[best].max() >= MISTAKEN * last.max():
            break
        change = left.pop(best)
        recordings = {name: change.of(pieces) for name, pieces in recordings.items()}
        now = {name: errs(recordings[name]) for name, errs in of_each.items()}
        right = [name for name in now if now[name] >= MISTAKEN * last_of_each[name]]
        wrong = [name for name in now if name not in right] if right else []
        found.append(Mistake(change.words, float(tried[best][0] / last[0]), wrong))
        rollouts, last, last_of_each = change.of(rollouts), tried[best], now
    return found


def changes(task: Task) -> list[Change]:
    """Candidate changes: signs of each input, of each joint with its velocity, of all inputs; swapped pairs.

    If all signs are reversed, swapping two inputs may reduce errors more than correcting one sign.
    """
    names = [each.name for each in (*task.states, *task.inputs)]
    inputs = [[place] for place in range(len(task.states), len(names))]
    joints = [[place, rate] for rate, place in rates_of(task).items()]
    as_recorded, same = np.arange(len(names)), np.ones(len(names))
    made = []
    every = [[place for each in inputs for place in each]] if len(inputs) > 1 else []
    for places in (*inputs, *joints, *every):
        signs = same.copy()
        signs[places] = -1.0
        words = f"the sign of {' and '.join(names[place] for place in places)} reversed"
        made.append(Change(words, as_recorded, signs))
    for some, others in (*combinations(inputs, 2), *combinations(joints, 2)):
        order = as_recorded.copy()
        order[[*some, *others]] = [*others, *some]
        pairs = zip(some, others, strict=True)
        words = ", ".join(f"{names[one]} and {names[other]}" for one, other in pairs)
        made.append(Change(f"{words} swapped", order, same))
    return made
