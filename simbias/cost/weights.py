"""Weights of quantities: a list, or by name or kind."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from simbias.core import Quantity
from simbias.core.quantities import by_quantity
from simbias.core.ranges import NonNegative
from simbias.core.records import Array

Weights = list[NonNegative] | dict[str, NonNegative]  # one for each quantity, or by name or kind


def weights_of(name: str, weights: Weights, quantities: Sequence[Quantity]) -> Array:
    """The weight of each quantity: by its index, or by its name or else its kind."""
    if not isinstance(weights, dict):
        if len(weights) != len(quantities):
            raise ValueError(f"{name} has {len(weights)} values; the task has {len(quantities)}")
        return np.array(weights)
    return by_quantity(weights, quantities, 0.0, f"{name}: nothing is called")
