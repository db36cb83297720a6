"""The quantities of states, inputs and outputs, and which of them are rates or angles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from simbias.core.records import Array, Indices

RATE = "/s"  # what the units of rates end with
TURNS = {"rad": 2 * np.pi, "mrad": 2e3 * np.pi, "deg": 360.0, "°": 360.0, "rev": 1.0}  # of angles, by unit


class Quantity(NamedTuple):
    """A component of a state, input or output vector."""

    name: str
    unit: str
    kind: str = ""  # what it shares with others, so that noise can be declared of all at once: "angle"
    wraps: bool = False  # whether it is an angle that is the same after a turn

    @property
    def names(self) -> tuple[str, ...]:
        """Names by which the quantity can be given, its own first."""
        return (self.name, self.kind) if self.kind else (self.name,)

    @property
    def is_rate(self) -> bool:
        """Whether it is a velocity, by its unit."""
        return self.unit.endswith(RATE)

    @property
    def turn(self) -> float:
        """A turn in the unit of what wraps; 0 of what does not."""
        return TURNS[self.unit] if self.wraps else 0.0


def wrapped(differences: Array, quantities: Sequence[Quantity]) -> Array:
    """Differences (..., k) of quantities; of those that wrap, within half a turn."""
    turns = np.array([quantity.turn for quantity in quantities])
    if not turns.any():
        return differences
    periods = np.where(turns, turns, 1.0)
    return differences - turns * np.floor((differences + periods / 2) / periods)


def unwound(values: Array, quantities: Sequence[Quantity]) -> Array:
    """Values (k, q) of quantities, those that wrap without jumps by a turn."""
    whole = values.copy()
    for column, quantity in zip(whole.T, quantities, strict=True):
        if quantity.wraps:
            column[:] = np.unwrap(column, period=quantity.turn)
    return whole


def by_quantity(
    values: Mapping[str, float],
    quantities: Sequence[Quantity],
    default: float,
    refusal: str,
    suffix: str = "",
) -> Array:
    """The value (k,) of each of k quantities: by its own name or else by its kind, and a suffix.

    ValueError if a name is of none of them: the refusal, that name, and those that there are.
    """
    names = [[name + suffix for name in quantity.names] for quantity in quantities]
    known = dict.fromkeys(name for own in names for name in own)
    for name in values:
        if name not in known:
            raise ValueError(f"{refusal} {name}; there is {', '.join(known)}")
    return np.array([next((values[name] for name in own if name in values), default) for own in names])


def rate_pairs(quantities: Sequence[Quantity]) -> list[tuple[int, int]]:
    """Places of positions and of their rates, which have the position's unit per second.

    Of several, a rate's name begins or ends with its position's; if names do not tell, they are in the same
    order.
    """
    pairs: list[tuple[int, int]] = []
    for unit in {quantity.unit for quantity in quantities}:
        positions, rates = (
            [i for i, quantity in enumerate(quantities) if quantity.unit == each]
            for each in (unit, unit + RATE)
        )
        names = [quantities[i].name for i in positions]
        named = [_longest_within(quantities[rate].name, names) for rate in rates]
        if all(named) and len(set(named)) == len(named):
            positions = [positions[names.index(name)] for name in named]
        pairs += zip(positions, rates, strict=False)
    return sorted(pairs)


def _longest_within(name: str, others: Sequence[str]) -> str:
    """The longest of others that a name begins or ends with; "" if there is none."""
    within = (each for each in others if name.startswith(each) or name.endswith(each))
    return max(within, key=len, default="")


def rates_and_positions(quantities: Sequence[Quantity]) -> tuple[Indices, Indices]:
    """Places (n / 2,) of rates, and of what they are the rates of.

    ValueError if a quantity is neither, and the names of all these.
    """
    pairs = np.array(rate_pairs(quantities), dtype=np.intp).reshape(-1, 2)
    if other := [quantity.name for i, quantity in enumerate(quantities) if np.sum(pairs == i) != 1]:
        raise ValueError(f"the task has not a rate for each position, by their units: {', '.join(other)}")
    return pairs[:, 1], pairs[:, 0]
