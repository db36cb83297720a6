"""Likely mistakes in signs, columns and units of recordings: changes that reduce the models' errors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, combinations
from typing import NamedTuple

import numpy as np

from simbias.core import Nominal, Task
from simbias.core.quantities import TURNS
from simbias.core.records import Array, Indices, Rollout
from simbias.lab.rates import rates_of
from simbias.recordings.horizons import geometric_mean, horizons, over_changes

MISTAKEN = 0.9  # ratio of errors below which a change is likely correct
CLEARLY = 0.5  # the same, for a change in some recordings alone
TENFOLD, AT_MOST = 0.1, 2.0  # see `_of_units`
AS_GOOD = 1.1  # ratio of errors up to which two explanations are as good
DEGREES = "deg"
PARTS = {"m": {"mm": 1e-3, "cm": 1e-2}}  # units that a column may be in, by the task's


class Mistake(NamedTuple):
    """A change of recordings that reduces the models' errors."""

    words: str
    times: float  # errors of the nominal model, relative to those before
    recordings: Sequence[str] = ()  # in which the change reduces errors; empty: all


class Change(NamedTuple):
    """A change of order and scale of states (n) and inputs (m)."""

    words: str
    order: Indices  # (n + m,)
    factors: Array  # (n + m,)
    unit: float = 0.0  # factor of a change of units of states; 0: none

    def instead(self, task: Task) -> Change:
        """The change of inputs that would explain it as well, if the dynamics were linear."""
        factors = np.where(np.arange(len(self.factors)) < len(task.states), 1.0, 1 / self.unit)
        return Change("", self.order, factors)

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
    """Mistakes, most important first; the first model is the nominal one.

    On a change of signs or order all models have to agree: if the nominal model lacks a spring, a wrong sign
    of an input below resonance reduces its errors, but not the identified model's. A detected change is kept,
    since a sign is wrong relative to the others.
    """
    judged = {n: each for n, each in recordings.items() if horizons(task, max(r.frames for r in each))}
    left, found = changes(task), list[Mistake]()
    if not judged:
        return found

    def errors(rollouts: Sequence[Rollout]) -> Array:
        return np.array([over_changes(task, model, rollouts) for model in models])

    rollouts = [each for pieces in recordings.values() for each in pieces]
    last = errors(rollouts)
    while left:
        tried = [errors(each.of(rollouts)) for each in left]
        ratios = [
            _of_units(errs, last) if each.unit else float((errs / last).max())
            for each, errs in zip(left, tried, strict=True)
        ]
        best = int(np.argmin(np.round(ratios, 3)))  # if mirrored, the input's sign
        if not ratios[best] < MISTAKEN:  # also if errors are no numbers
            break
        change, errs = left.pop(best), tried[best]
        words = change.words
        if change.unit and errors(change.instead(task).of(rollouts))[0] < AS_GOOD * errs[0]:
            words += f" or all inputs {1 / change.unit:.3g} times as large"
        now = {name: over_changes(task, models[0], change.of(recordings[name])) for name in judged}
        right = [n for n in now if now[n] >= MISTAKEN * over_changes(task, models[0], recordings[n])]
        wrong = [name for name in now if name not in right] if right else []
        found.append(Mistake(words, float(errs[0] / last[0]), wrong))
        recordings = {n: each if n in right else change.of(each) for n, each in recordings.items()}
        rollouts = [each for pieces in recordings.values() for each in pieces]
        last = errors(rollouts) if right else errs
    return [*found, *_in_some({name: recordings[name] for name in judged}, left, errors)]


def _in_some(
    recordings: Mapping[str, Sequence[Rollout]],
    left: Sequence[Change],
    errors: Callable[[Sequence[Rollout]], Array],
) -> Iterator[Mistake]:
    """Mistakes in some recordings alone; those in all would have been found together.

    All models err far less with the change, or one of them than all without, as those may be identified from
    the mistake. Of several mistakes in one recording, the clearest is found.
    """
    found: dict[str, dict[str, float]] = {}
    for name, pieces in recordings.items() if left and len(recordings) > 1 else ():
        before, after = errors(pieces), [errors(each.of(pieces)) for each in left]
        ratios = [min(errs.min() / before.min(), (errs / before).max()) for errs in after]
        if min(ratios) < CLEARLY:
            best = int(np.argmin(ratios))
            found.setdefault(left[best].words, {})[name] = after[best][0] / before[0]
    for words, of in found.items():
        if len(of) < len(recordings):
            yield Mistake(words, geometric_mean(np.array([*of.values()])), list(of))


def _of_units(errors: Array, last: Array) -> float:
    """The ratio of errors by which a change of units is judged: nominal ones, over all models' without it.

    A model identified from the wrong unit may predict almost no motion. So it counts as erring more, up to
    twice, if the change reduces the nominal model's errors more than tenfold.
    """
    return float(errors[0] / np.clip(TENFOLD * last[0], last.min(), AT_MOST * last.min()))


def changes(task: Task) -> list[Change]:
    """Candidates: signs of each input, of each joint with its velocity, of all inputs; swaps; joints' units.

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
    for unit in dict.fromkeys(task.states[place].unit for place, _ in joints):
        own = [each for each in joints if task.states[each[0]].unit == unit]
        for other, factor in _other_units(unit).items():
            for places in (*own, *all_of(own)):
                words = f"{told(places)} taken as {other}"
                made.append(Change(words, as_recorded, scaled(places, factor), factor))
    return made


def _other_units(unit: str) -> dict[str, float]:
    """Units that a column may be in instead of its own, and how many of its own each is."""
    if unit not in TURNS:
        return PARTS.get(unit, {})
    other = "rad" if unit == DEGREES else DEGREES
    return {other: TURNS[unit] / TURNS[other]}
