"""The limits of inputs, for policies that require them."""

from __future__ import annotations

import numpy as np

from simbias.core import Task
from simbias.core.records import Array


def limits_of(task: Task) -> tuple[Array, Array]:
    """Lower and upper limits (m,) of the inputs; ValueError if an input has none."""
    bounds = task.input_bounds
    for each, limits in zip(task.inputs, np.transpose(bounds), strict=True):
        if not np.isfinite(limits).all():
            raise ValueError(f"inputs.{each.name} has no limit, but this policy needs one")
    return bounds
