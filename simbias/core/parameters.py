"""Physical parameters that are not known exactly, and their independent priors.

Each parameter is an increasing function of a standard normal variable, its coordinate. Drawing coordinates
thus draws from the prior, and a posterior that is normal in the coordinates respects every bound.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from simbias.core.records import Array

LARGEST = 100.0  # exponent: a search for the mode may pass points where a parameter would overflow
FARTHEST = 37.0  # coordinate of a half-normal: beyond, its tail underflows, and the parameter is infinite

Prior = Literal["normal", "log_normal", "half_normal", "uniform"]


class Parameter(NamedTuple):
    """A physical parameter and its prior.

    The declared value is the median of `normal` and `log_normal`, and the lower end of `half_normal` and
    `uniform`. The spread is a standard deviation (of the logarithm, if `log_normal`; of the underlying normal
    distribution, if `half_normal`), or the width if `uniform`.
    """

    name: str
    unit: str
    value: float
    spread: float
    prior: Prior = "normal"
    of_recording: bool = False  #: whether its value differs between recordings, like an encoder's zero
    assumed: str = ""  #: a value that is not identified, and that its own depends on

    def at(self, coordinate: Array | float) -> Array:
        """Values (...) at coordinates (...)."""
        z = np.asarray(coordinate, dtype=np.float64)
        if self.prior == "normal":
            return self.value + self.spread * z
        if self.prior == "log_normal":
            exponent = np.copysign(self.spread, self.value) * z  # also a negative value increases
            return self.value * np.exp(np.clip(exponent, -LARGEST, LARGEST))
        from scipy.special import ndtr, ndtri  # lazily: most trials need none

        if self.prior == "half_normal":
            return self.value - self.spread * ndtri(ndtr(-np.minimum(z, FARTHEST)) / 2)
        return self.value + self.spread * ndtr(z)


def uncertain(
    values: Mapping[str, float], units: Mapping[str, str], uncertainty: Mapping[str, float]
) -> tuple[Parameter, ...]:
    """Parameters for the uncertain ones among some values: log-normal, or half-normal where a value is zero.

    ValueError if an uncertain name is not among the values.
    """
    for name in uncertainty:
        if name not in values:
            raise ValueError(f"uncertainty: nothing is called {name}; available: {', '.join(values)}")
    return tuple(
        Parameter(name, units[name], values[name], spread, "log_normal" if values[name] else "half_normal")
        for name, spread in uncertainty.items()
    )


def replaced(
    numbers: Array, names: Iterable[str], first: int, parameters: Sequence[Parameter], values: Array
) -> Array:
    """A copy of numbers, named from index `first` on, in which parameters have new values (k,)."""
    places = {name: place for place, name in enumerate(names, start=first)}
    changed = numbers.copy()
    changed[[places[parameter.name] for parameter in parameters]] = values
    return changed


def values_at(parameters: Sequence[Parameter], coordinates: Array) -> Array:
    """Values (..., k) of k parameters at coordinates (..., k)."""
    columns = [parameter.at(coordinates[..., i]) for i, parameter in enumerate(parameters)]
    return np.stack(columns, axis=-1) if columns else np.asarray(coordinates, dtype=np.float64)


class Estimate(NamedTuple):
    """The identified value of a parameter, and its uncertainty."""

    name: str
    unit: str
    declared: float
    value: float  #: the most probable value
    low: float  #: 5% quantile
    high: float  #: 95% quantile
