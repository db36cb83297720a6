"""Sensors, from the true state to the policy's measurement, before noise: an offset and a delay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import AfterValidator

from simbias.core import Task
from simbias.core.ranges import Coordinate
from simbias.core.records import Array
from simbias.simulation.noise import without_zeros

# As in a config: `theta: 0.01`, of a quantity in its unit.
Offsets = Annotated[dict[str, Coordinate], AfterValidator(without_zeros)]


class Sensor:
    """Sees each state some frames late, and some quantities off by a constant.

    Raises
    ------
    ValueError
        If the task has no state of that name.
    """

    def __init__(self, task: Task, offsets: Offsets, delay: int) -> None:
        names = [state.name for state in task.states]
        unknown = sorted(set(offsets) - set(names))
        if unknown:
            raise ValueError(f"no state is called {', '.join(unknown)}; there is {', '.join(names)}")
        self._offset = np.array([offsets.get(name, 0.0) for name in names])
        self._delay = delay

    def read(self, states: Sequence[Array], t: int) -> Array:
        """The reading (n,) in frame t, of the t + 1 states (n,) so far; at first, of the start."""
        return states[max(0, t - self._delay)] + self._offset
