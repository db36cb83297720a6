"""Likely mistakes in signs, columns and units of recordings: changes that reduce the models' errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain, combinations
from typing import NamedTuple

import numpy as np

from simbias.core import Nominal, Task
from simbias.core.quantities import TURNS
from simbias.core.records import Array, Indices, Rollout
from simbias.lab.rates import rates_of
from simbias.recordings.horizons import horizons, over_changes

MISTAKEN = 0.9  # ratio of errors below which a change is likely correct
DEGREES = "deg"


class Mistake(NamedTuple):
    """A change of recordings that reduces the models' errors."""

    words: str
    times: float  # errors of the nominal model, relative to those before
    recordings: Sequence[str]  # in which the change reduces errors; empty: all


class Change(NamedTuple):
    """A change of order and scale of states (n) and inputs (m)."""

    words: str
    order: Indices  # (n + m,)
    factors: Array  # (n + m,)
    of_unit: bool = False

    def of(self, rollouts: Sequence[Rollout]) -> list[Rollout]:
        """The rollouts with this change applied."""
        n = rollouts[0].states.shape[1]
        return [
            replace(
                each,
                states=self.factors[:n] * each.states[:, self.order[:n]],
                inputs=self.factors[n:] * each.inputs[:, self.order[n:] - n],
            )
            for each in rollouts
        ]


def mistakes(
    task: Task, models: Sequence[Nominal], recordings: Mapping[str, Sequence[Rollout]]
) -> list[Mistake]:
    """Mistakes on which all models agree, most important first; the first model is the nominal one.

    If the nominal model lacks a spring, a wrong sign of an input below resonance reduces its errors, but not
    the identified model's. A detected change is kept, since a sign is wrong relative to the others. A unit is
    wrong if the nominal model with the right one predicts better than all models without: those identified
    from the wrong one may be anywhere.
    """
    left, found = changes(task), []
    long = [n for n, each in recordings.items() if horizons(task, max(piece.frames for piece in each))]

    def errors(rollouts: Sequence[Rollout]) -> Array:
        return np.array([over_changes(task, model, rollouts) for model in models])

    def of_each() -> dict[str, float]:
        return {name: over_changes(task, models[0], recordings[name]) for name in long}

    rollouts = [each for pieces in recordings.values() for each in pieces]
    last, last_of_each = errors(rollouts), of_each()
    while left:
        tried = [errors(each.of(rollouts)) for each in left]
        ratios = [
            errs[0] / last.min() if each.of_unit else (errs / last).max()
            for each, errs in zip(left, tried, strict=True)
        ]
        best = int(np.argmin(np.round(ratios, 3)))  # if mirrored, the input's sign
        if ratios[best] >= MISTAKEN:
            break
        change = left.pop(best)
        recordings = {name: change.of(pieces) for name, pieces in recordings.items()}
        now = of_each()
        right = [name for name in now if now[name] >= MISTAKEN * last_of_each[name]]
        wrong = [name for name in now if name not in right] if right else []
        found.append(Mistake(change.words, float(tried[best][0] / last[0]), wrong))
        rollouts, last, last_of_each = change.of(rollouts), tried[best], now
    return found


def changes(task: Task) -> list[Change]:
    """Candidates: signs of each input, of each joint with its velocity, of all inputs; swaps; degrees.

    If all signs are reversed, swapping two inputs may reduce errors more than correcting one sign.
    """
    names = [each.name for each in (*task.states, *task.inputs)]
    inputs = [[place] for place in range(len(task.states), len(names))]
    joints = [[place, rate] for rate, place in rates_of(task).items()]
    as_recorded = np.arange(len(names))
    made = []

    def scaled(places: Sequence[int], factor: float) -> Array:
        return np.where(np.isin(as_recorded, places), factor, 1.0)

    def told(places: Sequence[int]) -> str:
        return " and ".join(names[place] for place in places)

    def all_of(several: Sequence[Sequence[int]]) -> list[list[int]]:
        return [[*chain(*several)]] if len(several) > 1 else []

    for places in (*inputs, *joints, *all_of(inputs)):
        made.append(Change(f"the sign of {told(places)} reversed", as_recorded, scaled(places, -1.0)))
    for some, others in (*combinations(inputs, 2), *combinations(joints, 2)):
        order = as_recorded.copy()
        order[[*some, *others]] = [*others, *some]
        pairs = zip(some, others, strict=True)
        words = ", ".join(f"{names[one]} and {names[other]}" for one, other in pairs)
        made.append(Change(f"{words} swapped", order, scaled([], 1.0)))
    angles = [each for each in joints if task.states[each[0]].unit in TURNS]
    for places in (*angles, *all_of(angles)):
        unit = task.states[places[0]].unit
        other = "rad" if unit == DEGREES else DEGREES
        factors = scaled(places, TURNS[unit] / TURNS[other])
        made.append(Change(f"{told(places)} taken as {other}", as_recorded, factors, of_unit=True))
    return made
