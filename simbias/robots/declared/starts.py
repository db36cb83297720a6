"""The starts of a declared task's episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from simbias.core.ranges import Coordinate, NonNegative
from simbias.core.records import Array

Range = Annotated[list[Coordinate], Field(min_length=2, max_length=2)]


@dataclass(frozen=True)
class State:
    """A state and its start, mean + N(0, deviation^2); the mean is a number, uniform or one of `values`."""

    unit: str
    kind: str = ""  # common to several, so that noise can be declared for all at once
    mean: Coordinate = 0.0
    deviation: NonNegative = 0.0  # of hardware starts
    uniform: Range | None = None  # least and largest mean
    values: Annotated[list[Coordinate], Field(min_length=1)] | None = None  # means; a grid for several states
    wraps: bool = False  # whether it is an angle, in any unit of angle, modulo one turn


class Starts:
    """A distribution of starts: drawn means, and normal deviations from them.

    States are given by their keys in the config, such as `states.angle`. ValueError if one declares more than
    one mean, or one that `starts` replace, or if a start lacks a number for some state.
    """

    def __init__(self, states: Mapping[str, State], starts: Sequence[Sequence[float]] | None) -> None:
        for key, state in states.items():
            if state.uniform is not None and not state.uniform[0] < state.uniform[1]:
                raise ValueError(f"{key}: uniform is {list(state.uniform)}; its ends must increase")
            if (state.uniform is not None) + (state.values is not None) + (state.mean != 0) > 1:
                raise ValueError(f"{key}: give only one of mean, uniform and values")
            if starts is not None and (state.uniform or state.values):
                raise ValueError(f"{key}: starts replace its uniform or values; give one of them")
        if any(len(start) != len(states) for start in starts or ()):
            raise ValueError(f"starts: each must have {len(states)} numbers, one for each state")
        self._states = tuple(states.values())
        self._starts = None if starts is None else np.array(starts, dtype=np.float64)
        self._noise = np.array([state.deviation for state in self._states])
        means = [np.mean(_means(state)) for state in self._states]
        spreads = [_spread(state) for state in self._states]
        self.mean = np.array(means) if self._starts is None else self._starts[0]  # (n,)
        listed = 0.0 if self._starts is None else np.std(self._starts, axis=0)
        self.deviation = np.sqrt(self._noise**2 + np.square(spreads) + np.square(listed))  # (n,)
        if not (np.any(spreads) or np.any(listed)):
            self.deviation = self._noise

    @property
    def means(self) -> Mapping[str, Array]:
        """States (n,) around which episodes start, by their keys; empty if these are drawn."""
        if self._starts is None:
            return {} if any(map(_spread, self._states)) else {"states": self.mean}
        return {f"starts.{index}": start for index, start in enumerate(self._starts)}

    def draw(self, rng: np.random.Generator) -> Array:
        """A start (n,)."""
        deviation = self._noise * rng.standard_normal(len(self._states))
        if self._starts is not None:
            return self._starts[rng.integers(len(self._starts))] + deviation
        mean = self.mean.copy()
        for index, state in enumerate(self._states):
            if state.uniform is not None:
                mean[index] = rng.uniform(state.uniform[0], state.uniform[1])
            elif state.values is not None:
                mean[index] = rng.choice(state.values)
        return mean + deviation


def _means(state: State) -> Sequence[float]:
    """Numbers whose average is the state's mean start."""
    return state.uniform or state.values or [state.mean]


def _spread(state: State) -> float:
    """The standard deviation of a state's mean."""
    if state.uniform is not None:
        return float(np.ptp(state.uniform) / np.sqrt(12))
    return float(np.std(_means(state)))
