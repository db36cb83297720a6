"""The delay of motors, whatever else of a robot is known."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import partial
from typing import final

import numpy as np

from simbias.core import Identification, Nominal, Task
from simbias.core.parameters import Estimate
from simbias.core.ranges import Count, Seconds
from simbias.core.records import Array, Rollout, Transitions
from simbias.learning.covariance import hyperparameters
from simbias.learning.likelihood import HyperPriors, mode
from simbias.simulation.actuator import Actuator, Actuators, taps_of
from simbias.simulation.compiler import of_nominal, points_of

STEPS = 2  # candidate delays in each frame
MOST = 24  # candidates beside no delay: each likelihood takes up to a second


class Delay(Identification):
    """The most probable delay of all motors, whatever the robot does with its inputs once they act.

    For each delay, Gaussian processes of the nominal model's residuals, with learned hyper-parameters, are
    functions of the states and of the inputs that act. Their marginal likelihood tells the delay: with a
    wrong one, the processes see inputs that did not cause the residuals, and take the difference for noise.
    A lag counts as a delay.

    Parameters
    ----------
    longest
        In s; all delays up to it have the same prior probability.
    points
        Most samples of a likelihood, evenly spaced in the data; its time grows with their number cubed.
    draws
        Draws of the model have any delay, by its probability; else the most probable one, too.
    """

    def __init__(self, task: Task, longest: Seconds = 0.06, points: Count = 200, draws: bool = False) -> None:
        self._task, self._draws = task, draws
        self._taps = taps_of(longest, task.time_step)
        count = min(int(STEPS * longest / task.time_step + 1e-9), MOST)
        step = max(task.time_step / STEPS, longest / MOST)
        self._delays = step * np.arange(count + 1, dtype=np.float64)
        self._learning = HyperPriors(points=points)
        self._medians = hyperparameters(task, 1.0, 1.0, 0.02, 1.0, None, periodic=True)

    def fit(self, nominal: Nominal, rollouts: Sequence[Rollout]) -> Late:
        """The model behind motors of the most probable delay, by all rollouts; of none without rollouts.

        Raises
        ------
        ValueError
            If the model has a delay, or another state, of its own.
        """
        candidates = [Late(self._task, nominal, delay, self._taps) for delay in self._delays.tolist()]
        log_evidence = np.zeros(len(candidates))
        if rollouts:
            log_evidence[:] = [self._log_evidence(model, rollouts) for model in candidates]
        probabilities = np.exp(log_evidence - log_evidence.max())
        probabilities /= probabilities.sum()
        best = copy(candidates[int(np.argmax(log_evidence))])
        if rollouts:
            best.estimates = (_estimate(self._delays, probabilities),)
            best.at_longest = best.delay == self._delays[-1]
        if self._draws:
            best.drawn_from = candidates, probabilities
        return best

    def _log_evidence(self, model: Late, rollouts: Sequence[Rollout]) -> float:
        """Of the residuals along the rollouts, in nats."""
        data = Transitions.empty(len(self._task.states), len(self._task.inputs))
        for rollout in rollouts:
            states, sent = rollout.with_history()
            x = states[:-1]
            inputs = np.concatenate([x, model.acted_along(x, sent)], axis=1)
            own = slice(len(sent) - rollout.frames, None)
            data |= Transitions(inputs[own], (states[1:] - model.along(x, sent))[own])
        return mode(self._medians, data, self._learning)[1]


def _estimate(delays: Array, probabilities: Array) -> Estimate:
    """The most probable delay, the shortest of several, and an interval with it and 90% of the mass.

    The interval reaches to the neighbours of what is considered: the likelihood of a model that is not exact
    is too sure of one.
    """
    step = float(delays[-1] - delays[0]) / max(1, len(delays) - 1)
    below, value = np.cumsum(probabilities), float(delays[np.argmax(probabilities)])
    low, high = delays[[int(np.sum(below < share)) for share in (0.05, 0.95)]].tolist()
    return Estimate("delay", "s", 0.0, value, max(0.0, min(low, value) - step), max(high, value) + step)


@final
class Late(Nominal):
    """A model behind motors that are late; its bias is a function of the inputs that act.

    A bias of the commands could not express a delay: what the robot does depends on earlier ones. Draws have
    the delays of other models by their probabilities, if it is `drawn_from` these.

    Raises
    ------
    ValueError
        If the model has a delay, or another state, of its own.
    """

    drawn_from: tuple[Sequence[Late], Array] | None = None
    at_longest = False  # whether no longer delay was considered

    def __init__(self, task: Task, nominal: Nominal, delay: float, taps: int) -> None:
        self._task, self.delay = task, delay
        self._actuators = Actuators([Actuator(delay=delay)] * len(task.inputs), task.time_step, taps)
        self.state_size = self._actuators.state_size
        self.acting = tuple(range(0, self.state_size, 1 + taps))
        self._put_behind(nominal)

    def oddity(self) -> tuple[str, str] | None:
        """Whether the motors may be later than any delay that was considered."""
        if not self.at_longest:
            return None
        return "the motors may be later than identification.longest", (
            f"the most probable delay of the motors is the longest that is considered ({self.delay:g} s), "
            "so they may be later: raise identification.longest"
        )

    def _put_behind(self, nominal: Nominal) -> None:
        """Let the motors drive this model."""
        if nominal.state_size:
            raise ValueError("identification=delay: the nominal model has lag and delay of its own")
        self._nominal, self.parameters = nominal, nominal.parameters
        mechanics = of_nominal(nominal, partial(points_of, self._task)).kernel
        self.kernel = None if mechanics is None else self._actuators.before(mechanics)

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n) after x (..., n), as if u (..., m) had acted for long."""
        return self._nominal.step(x, u)

    def advance(self, x: Array, u: Array, model_state: Array) -> tuple[Array, Array]:
        """x_next (..., n), and the inputs (..., s) that later frames need."""
        acting, kept = self._actuators.acting(u, model_state)
        return self._nominal.step(x, acting), kept

    def model_states(self, states: Array, inputs: Array) -> Array:
        """Inputs (k, s) before each frame of a record."""
        return self._actuators.model_states(inputs)

    def with_parameters(self, values: Array) -> Late:
        """The model with other values (k,) of its parameters, as late as it is."""
        return self._driving(self._nominal.with_parameters(values))

    def draw(self, rng: np.random.Generator) -> Late:
        """A draw of the model behind the motors, and of their delay if that is drawn."""
        motors = self
        if self.drawn_from:
            models, probabilities = self.drawn_from
            motors = models[rng.choice(len(models), p=probabilities)]
        return motors._driving(self._nominal.draw(rng))

    @property
    def slack(self) -> Array:
        """That of the model behind the motors."""
        return self._nominal.slack

    def without_dry_friction(self) -> Late:
        """The model without friction, as late as it is."""
        return self._driving(self._nominal.without_dry_friction())

    def _driving(self, nominal: Nominal) -> Late:
        """The same motors before another model."""
        other = copy(self)
        other._put_behind(nominal)
        return other
