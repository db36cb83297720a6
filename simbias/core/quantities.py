"""The quantities of states, inputs and outputs, and which of them are rates or angles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from simbias.core.ranges import NonNegative
from simbias.core.records import Array, Indices

RATE = "/s"  # what the units of rates end with
TURNS = {"rad": 2 * np.pi, "mrad": 2e3 * np.pi, "deg": 360.0, "°": 360.0, "rev": 1.0}  # of angles, by unit
Weights = list[NonNegative] | dict[str, NonNegative]  # one for each quantity, or by name or kind


class Quantity(NamedTuple):
    """A component of a state, input or output vector."""

    name: str  #: in configs and tables
    unit: str  #: "" if there is none
    kind: str = ""  #: common to several, so that noise can be declared for all at once: "angle"
    wraps: bool = False  #: whether it is an angle modulo one turn

    @property
    def names(self) -> tuple[str, ...]:
        """Names by which the quantity can be given, its own first."""
        return (self.name, self.kind) if self.kind else (self.name,)

    @property
    def is_rate(self) -> bool:
        """Whether its unit is that of a velocity."""
        return self.unit.endswith(RATE)

    @property
    def turn(self) -> float:
        """One full turn in the quantity's unit; 0 if it does not wrap."""
        return TURNS[self.unit] if self.wraps else 0.0


def wrapped(differences: Array, quantities: Sequence[Quantity]) -> Array:
    """Differences (..., k) of quantities; those that wrap are brought within half a turn."""
    turns = np.array([quantity.turn for quantity in quantities])
    if not turns.any():
        return differences
    periods = np.where(turns, turns, 1.0)
    return differences - turns * np.floor((differences + periods / 2) / periods)


def unwound(values: Array, quantities: Sequence[Quantity]) -> Array:
    """Values (k, q) of quantities, with jumps by a turn removed from those that wrap."""
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
    """Values (k,) of k quantities, each looked up by its name or else by its kind, with a suffix.

    ValueError if a name belongs to none of them; it states the refusal, that name and all known names.
    """
    names = [[name + suffix for name in quantity.names] for quantity in quantities]
    known = dict.fromkeys(name for own in names for name in own)
    for name in values:
        if name not in known:
            raise ValueError(f"{refusal} {name}; available: {', '.join(known)}")
    return np.array([next((values[name] for name in own if name in values), default) for own in names])


def weights_of(name: str, weights: Weights, quantities: Sequence[Quantity]) -> Array:
    """The weight of each quantity: by its index, or by its name or else its kind."""
    if not isinstance(weights, dict):
        if len(weights) != len(quantities):
            raise ValueError(f"{name} has {len(weights)} values; the task has {len(quantities)}")
        return np.array(weights)
    try:
        return by_quantity(weights, quantities, 0.0, f"{name}: nothing is called")
    except ValueError as error:
        raise ValueError(f"{error}; ~cost.{name}.NAME leaves out one of the option's own") from error


def rate_pairs(quantities: Sequence[Quantity]) -> list[tuple[int, int]]:
    """Index pairs of positions and their rates, which have the position's unit per second.

    If several have the same unit, a rate's name begins or ends with its position's name; failing that,
    positions and rates are paired in order.
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
    """The longest of the others with which a name begins or ends; "" if there is none."""
    within = (each for each in others if name.startswith(each) or name.endswith(each))
    return max(within, key=len, default="")


def rates_and_positions(quantities: Sequence[Quantity]) -> tuple[Indices, Indices]:
    """Indices (n / 2,) of the rates and of their positions.

    ValueError, with their names, if some quantities are neither.
    """
    pairs = np.array(rate_pairs(quantities), dtype=np.intp).reshape(-1, 2)
    if other := [quantity.name for i, quantity in enumerate(quantities) if np.sum(pairs == i) != 1]:
        raise ValueError(f"the task needs one rate for each position, by units; unpaired: {', '.join(other)}")
    return pairs[:, 1], pairs[:, 0]
