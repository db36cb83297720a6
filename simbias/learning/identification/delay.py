"""The delay of motors, identified regardless of what else is known of a robot."""

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

STEPS = 2  # candidate delays per frame
MOST = 24  # candidates besides zero: each likelihood takes up to a second


class Delay(Identification):
    """The most probable common delay of all motors, for any effect of the delayed inputs on the robot.

    For each delay, the nominal model's residuals are Gaussian processes of the states and the delayed inputs,
    with learned hyper-parameters. Their marginal likelihood identifies the delay: with a wrong one, the
    processes have inputs that did not cause the residuals, and explain the difference as noise. A lag counts
    as a delay.

    Parameters
    ----------
    longest
        The longest delay, in s; all delays up to it have the same prior probability.
    points
        Maximum number of samples in a likelihood, evenly spaced in the data; the computing time is cubic in
        it.
    draws
        Whether draws of the model have random delays, by their probabilities; otherwise the most probable
        one.
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
        """The model behind motors with the most probable delay given all rollouts; zero without rollouts.

        Raises
        ------
        ValueError
            If the model already has a delay or another model state.
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
        """Log evidence in nats of the residuals along the rollouts."""
        data = Transitions.empty(len(self._task.states), len(self._task.inputs))
        for rollout in rollouts:
            states, sent, earlier = rollout.with_history()
            x = states[:-1]
            inputs = np.concatenate([x, model.acted_along(x, sent)], axis=1)
            residuals = states[1:] - model.along(x, sent)
            data |= Transitions(inputs[earlier:], residuals[earlier:])
        return mode(self._medians, data, self._learning)[1]


def _estimate(delays: Array, probabilities: Array) -> Estimate:
    """The most probable delay, the shortest if several tie, and an interval with it and 90% of the mass.

    The interval extends to the neighbouring candidates: the likelihood of an inexact model is overconfident.
    """
    step = float(delays[-1] - delays[0]) / max(1, len(delays) - 1)
    below, value = np.cumsum(probabilities), float(delays[np.argmax(probabilities)])
    low, high = delays[[int(np.sum(below < share)) for share in (0.05, 0.95)]].tolist()
    return Estimate("delay", "s", 0.0, value, max(0.0, min(low, value) - step), max(high, value) + step)


@final
class Late(Nominal):
    """A model behind delayed motors; its bias is a function of the acting inputs.

    A bias that depends on the commands could not express a delay, which makes the robot depend on earlier
    commands. If `drawn_from` lists other models, draws have their delays, by their probabilities.

    Raises
    ------
    ValueError
        If the model already has a delay or another model state.
    """

    drawn_from: tuple[Sequence[Late], Array] | None = None
    at_longest = False  # whether it has the longest delay considered

    def __init__(self, task: Task, nominal: Nominal, delay: float, taps: int) -> None:
        self._task, self.delay = task, delay
        self._actuators = Actuators([Actuator(delay=delay)] * len(task.inputs), task.time_step, taps)
        self.state_size = self._actuators.state_size
        self.acting = tuple(range(0, self.state_size, 1 + taps))
        self._put_behind(nominal)

    def oddity(self) -> tuple[str, str] | None:
        """An oddity if the motors' delay may exceed all that were considered."""
        if not self.at_longest:
            return None
        return "the motors may be later than identification.longest", (
            f"the most probable delay of the motors is the longest considered ({self.delay:g} s), "
            "so the true one may be longer; raise identification.longest"
        )

    def _put_behind(self, nominal: Nominal) -> None:
        """Put this model behind the motors."""
        if nominal.state_size:
            raise ValueError("identification=delay: the nominal model has its own lag and delay")
        self._nominal, self.parameters = nominal, nominal.parameters
        mechanics = of_nominal(nominal, partial(points_of, self._task)).kernel
        self.kernel = None if mechanics is None else self._actuators.before(mechanics)

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n) after x (..., n), as if u (..., m) had acted for long."""
        return self._nominal.step(x, u)

    def advance(self, x: Array, u: Array, model_state: Array) -> tuple[Array, Array]:
        """x_next (..., n), and the earlier inputs (..., s) that later frames need."""
        acting, kept = self._actuators.acting(u, model_state)
        return self._nominal.step(x, acting), kept

    def model_states(self, states: Array, inputs: Array) -> Array:
        """Earlier inputs (k, s) before each frame of a record."""
        return self._actuators.model_states(inputs)

    def with_parameters(self, values: Array) -> Late:
        """The model with other values (k,) of its parameters and the same delay."""
        return self._driving(self._nominal.with_parameters(values))

    def draw(self, rng: np.random.Generator) -> Late:
        """A draw of the model behind the motors and, if `drawn_from` is given, of their delay."""
        motors = self
        if self.drawn_from:
            models, probabilities = self.drawn_from
            motors = models[rng.choice(len(models), p=probabilities)]
        return motors._driving(self._nominal.draw(rng))

    @property
    def slack(self) -> Array:
        """The slack of the model behind the motors."""
        return self._nominal.slack

    def without_dry_friction(self) -> Late:
        """The model without dry friction, with the same delay."""
        return self._driving(self._nominal.without_dry_friction())

    def _driving(self, nominal: Nominal) -> Late:
        """The same motors in front of another model."""
        other = copy(self)
        other._put_behind(nominal)
        return other
