"""Noise and pushes, on hardware and in simulation (Section VI-A), and noise-free sensor readings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import AfterValidator

from simbias.core import Push, Task
from simbias.core.quantities import by_quantity
from simbias.core.ranges import Coordinate, Variance
from simbias.core.records import Array, Disturbance


def without_zeros(values: dict[str, float]) -> dict[str, float]:
    """The nonzero values by name: a quantity without noise or offset need not be declared."""
    return {name: value for name, value in values.items() if value}


# As in a config: `torque_variance: 0.1`, of a quantity or a kind, in the square of its unit.
Variances = Annotated[dict[str, Variance], AfterValidator(without_zeros)]
# `theta: 0.01`, of a quantity in its unit.
Offsets = Annotated[dict[str, Coordinate], AfterValidator(without_zeros)]
QUIET: dict[str, float] = {}


class Noise:
    """Zero-mean Gaussian noise on a task's inputs and on the states that its policy sees (Table II).

    Variances are `<name>_variance` of a quantity, or `<kind>_variance` of all other quantities of a kind. The
    task's pushes are added to the noise on the inputs. Targets have no noise: they are known.

    ValueError if the task has neither a quantity nor a kind of that name.
    """

    def __init__(self, task: Task, variances: Variances) -> None:
        states = task.without_targets.states
        known = by_quantity(variances, (*task.inputs, *states), 0.0, "no noise is called", "_variance")
        self._horizon, self._pushes = task.horizon, task.pushes
        self._times = task.time_step * np.arange(task.horizon)[:, None]  # (T, 1)
        self.input_variance = known[: len(task.inputs)]  # (m,)
        self.sensor_variance = np.append(known[len(task.inputs) :], np.zeros(len(task.targets)))  # (n,)

    @property
    def is_silent(self) -> bool:
        """Whether there is neither noise nor a push."""
        return not (self._pushes or self.input_variance.any() or self.sensor_variance.any())

    def draw(self, rng: np.random.Generator) -> Disturbance:
        """Noise for a whole rollout.

        The draws depend neither on the variances nor on when the rollout fails, so noise levels are compared
        with common random numbers.
        """
        inputs = rng.standard_normal((self._horizon, len(self.input_variance)))
        sensors = rng.standard_normal((self._horizon + 1, len(self.sensor_variance)))
        inputs *= np.sqrt(self.input_variance)
        for push in self._pushes:
            inputs[:, push.input] += self._pulses(push, rng)
        return Disturbance(inputs, np.sqrt(self.sensor_variance) * sensors)

    def _pulses(self, push: Push, rng: np.random.Generator) -> Array:
        """The pulses (T,) of an episode."""
        middle = rng.uniform(0.0, self._times[-1, 0], push.pulses)
        height = rng.uniform(*push.amplitude, push.pulses) * rng.choice([-1.0, 1.0], push.pulses)
        width = rng.uniform(*push.seconds, push.pulses)
        return (height * np.exp(-0.5 * ((self._times - middle) / width) ** 2)).sum(axis=1)


class Sensor:
    """A sensor with a delay in frames, and constant offsets of some quantities.

    ValueError if the task has no state of that name.
    """

    def __init__(self, task: Task, offsets: Offsets, delay: int) -> None:
        names = [state.name for state in task.states]
        unknown = sorted(set(offsets) - set(names))
        if unknown:
            raise ValueError(f"no state is called {', '.join(unknown)}; available: {', '.join(names)}")
        self._offset = np.array([offsets.get(name, 0.0) for name in names])
        self._delay = delay

    def read(self, states: Sequence[Array], t: int) -> Array:
        """The reading (n,) in frame t, from the t + 1 states (n,) so far; initially, of the start."""
        return states[max(0, t - self._delay)] + self._offset
