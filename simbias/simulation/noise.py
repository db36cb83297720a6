"""Noise on inputs and sensors, on hardware and in simulation (Section VI-A)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import AfterValidator

from simbias.core import Quantity, Task
from simbias.core.ranges import Variance
from simbias.core.records import Array, Disturbance

SUFFIX = "_variance"


def _without_zeros(variances: dict[str, float]) -> dict[str, float]:
    """What is declared to have no noise need not be declared."""
    return {key: variance for key, variance in variances.items() if variance}


# As in a config: `torque_variance: 0.1`, of a quantity or of all of a kind, in the square of its unit.
Variances = Annotated[dict[str, Variance], AfterValidator(_without_zeros)]
QUIET: dict[str, float] = {}


class Noise:
    """Zero-mean Gaussian noise on a task's inputs and on what its policy sees of the states (Table II).

    Parameters
    ----------
    variances
        `<name>_variance` of a quantity, or `<kind>_variance` of all quantities of a kind that have no own.

    Raises
    ------
    ValueError
        If the task has neither a quantity nor a kind of that name.
    """

    def __init__(self, task: Task, variances: Variances) -> None:
        known = {name for quantity in (*task.inputs, *task.states) for name in quantity.names}
        for key in variances:
            if not (key.endswith(SUFFIX) and key.removesuffix(SUFFIX) in known):
                raise ValueError(
                    f"no noise is called {key}; there is {', '.join(n + SUFFIX for n in sorted(known))}"
                )
        self._horizon = task.horizon
        self.input_variance = _variances(task.inputs, variances)  # (m,)
        self.sensor_variance = _variances(task.states, variances)  # (n,)

    @property
    def is_silent(self) -> bool:
        """Whether there is none."""
        return not (self.input_variance.any() or self.sensor_variance.any())

    def draw(self, rng: np.random.Generator) -> Disturbance:
        """Noise for a whole rollout.

        The draws depend neither on the variances nor on when the rollout fails, so noise levels compare on
        common random numbers.
        """
        inputs = rng.standard_normal((self._horizon, len(self.input_variance)))
        sensors = rng.standard_normal((self._horizon + 1, len(self.sensor_variance)))
        return Disturbance(np.sqrt(self.input_variance) * inputs, np.sqrt(self.sensor_variance) * sensors)


def _variances(quantities: Sequence[Quantity], variances: Variances) -> Array:
    """The variance of each quantity: its own, or else its kind's."""
    own = [
        [variances[n + SUFFIX] for n in quantity.names if n + SUFFIX in variances] for quantity in quantities
    ]
    return np.array([values[0] if values else 0.0 for values in own])
