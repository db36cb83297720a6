"""The task of a robot, and the hardware that runs experiments."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import copy
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple, final

import numpy as np

from simbias.core.policy import Policy
from simbias.core.quantities import Quantity, wrapped
from simbias.core.records import Array, Indices, Rollout

NEGLIGIBLE = 0.01  # share of the largest error
NOT_A_NUMBER = "not_a_number"  # failure name of a non-finite state that violates no criterion


class HardwareError(RuntimeError):
    """The hardware could not carry out an experiment; a robot that falls is a failure, not an error.

    `returned` keeps what the hardware returned instead of a rollout: the robot may have moved.
    """

    def __init__(self, problem: str, returned: Any = None) -> None:
        super().__init__(problem)
        self.returned = returned


class Waiting(Exception):  # noqa: N818 (no error: a lab takes its time)
    """The result of an experiment is not there yet; the message says what to do meanwhile."""


class Criterion(NamedTuple):
    """A failure criterion (Section IV-C): a state fails if its measure exceeds the limit."""

    name: str  #: of the failure, in records
    words: str  #: what happened, for people
    limit: float  #: of the measure; beyond it, the robot has failed
    unit: str  #: of the measure
    bounds: Mapping[str, float] = MappingProxyType({})  #: state -> its largest magnitude, whatever the others


class Push(NamedTuple):
    """Random pushes on an input during an episode: Gaussian pulses of either sign at random times."""

    input: int  #: index of the pushed input
    pulses: int  #: number in an episode
    amplitude: tuple[float, float]  #: least and largest, in the input's unit; it may exceed the input's limit
    seconds: tuple[float, float]  #: standard deviation of a pulse, least and largest


def failure_name(criteria: Sequence[Criterion], index: int) -> str:
    """The name of a violated criterion, or of the failure of a non-finite state that violates none."""
    return criteria[index].name if index < len(criteria) else NOT_A_NUMBER


class Task(ABC):
    """A task: quantities, time, limits, starts, goal, success and failure, but no dynamics.

    The goal is that `aim` equals `reference` at each time: by default, all states are zero. Targets are drawn
    with the start and stay constant; task, policy and cost know them exactly. Models, hardware and learners
    handle the robot alone (`without_targets`).
    """

    states: tuple[Quantity, ...]  #: n, those of the robot, then the targets
    targets: tuple[Quantity, ...] = ()  #: the last of the states
    inputs: tuple[Quantity, ...]  #: m
    outputs: tuple[Quantity, ...]  #: q, which a policy may feed back
    criteria: tuple[Criterion, ...]  #: of failure (Section IV-C)
    time_step: float  #: s
    horizon: int  #: T, frames
    input_limit: Array  #: (m,) largest magnitudes; the inputs' scale
    start_mean: Array  #: (n,)
    start_deviation: Array  #: (n,)
    pushes: tuple[Push, ...] = ()  #: on inputs, in simulation and on simulated hardware
    joints: tuple[tuple[str, ...], ...] = ()  #: in models' files, in orders in which the task reads states

    @property
    def input_bounds(self) -> tuple[Array, Array]:
        """Lower and upper limits (m,) of the inputs; a task with asymmetric limits overrides this."""
        return -self.input_limit, self.input_limit

    @property
    def without_targets(self) -> Task:
        """The task without targets, as models and hardware use it."""
        return WithoutTargets(self) if self.targets else self

    def targets_in(self, x: Array) -> Array:
        """The targets (..., k) among states x (..., n)."""
        return x[..., len(self.states) - len(self.targets) :]

    @property
    def goals(self) -> tuple[Quantity, ...]:
        """The quantities in which the goal is stated."""
        return self.states

    def aim(self, x: Array) -> Array:
        """The goal's quantities (..., g) at states x (..., n)."""
        return x

    def reference(self, t: Any, targets: Array | None = None) -> Array:
        """Reference values (..., g) or (g,) of the goal's quantities at times t (...) in s.

        It may depend on the task's targets (..., k); None: their means.
        """
        return np.zeros(len(self.goals))

    def error(self, x: Array, t: Any) -> Array:
        """The deviation (..., g) of states x (..., n) from the goal at times t (...) in s."""
        reference = self.reference(t, self.targets_in(x)) if self.targets else self.reference(t)
        return wrapped(self.aim(x) - reference, self.goals)

    def succeeds(self, states: Array) -> bool | None:
        """Whether an episode with states (T+1, n) that has not failed succeeds; None: its cost decides."""
        return None

    def uptime(self, states: Array) -> float:
        """The share of the horizon in which an episode with states (T+1, n) meets the conditions of success.

        Frames after a failure do not meet them. nan: the task states no conditions on single frames.
        """
        return np.nan

    @property
    def says_success(self) -> bool:
        """Whether the task decides which episodes succeed; otherwise their costs decide."""
        return self.succeeds(np.tile(self.start_mean, (self.horizon + 1, 1))) is not None

    def shortfalls(self, states: Array) -> Array:
        """How far (T+1, k) states (T+1, n) are from each of k things that keep an episode from success.

        By default, one distance from the goal, without rates: each error is relative to its largest, and
        less than `NEGLIGIBLE` counts as zero.
        """
        errors = np.abs(self.error(states, self.time_step * np.arange(len(states))))
        places = [i for i, goal in enumerate(self.goals) if not goal.is_rate] or [0]
        relative = errors[:, places] / (errors[:, places].max(axis=0) + 1e-300)
        return np.maximum(np.linalg.norm(relative, axis=1, keepdims=True) - NEGLIGIBLE, 0.0)

    def missed(self, states: Array) -> str:
        """How an episode with states (T+1, n) that has not failed misses success, in words."""
        errors = np.abs(self.error(states[-1], self.time_step * (len(states) - 1)))
        off = (f"{goal.name} {error:.3g} {goal.unit}" for goal, error in zip(self.goals, errors, strict=True))
        return f"at its end off by {', '.join(off)}"

    @abstractmethod
    def measure(self, x: Array) -> Array:
        """Measures (..., c) of states x (..., n), to be compared with the limits of the criteria."""

    @abstractmethod
    def output(self, x: Array) -> Array:
        """Outputs z (..., q) of states x (..., n), from which a policy computes its input."""

    def violated(self, x: Array) -> Indices:
        """Index (...) of the first criterion that each state x (..., n) violates, -1 where it violates none.

        A non-finite state that violates none gets the index after the last criterion.
        """
        within = self.measure(x) <= np.array([criterion.limit for criterion in self.criteria])
        within = np.concatenate([within, np.isfinite(x).all(axis=-1, keepdims=True)], axis=-1)
        return np.where(within.all(axis=-1), -1, np.argmin(within, axis=-1))

    def failure(self, x: Array) -> str | None:
        """Name of the first criterion that the state x (n,) violates, or None."""
        index = int(self.violated(x))
        return None if index < 0 else failure_name(self.criteria, index)

    def words(self, failure: str) -> str:
        """A failure in words: its criterion's words, or the name that the hardware gave it."""
        words = {criterion.name: criterion.words for criterion in self.criteria}
        return words.get(failure, failure.replace("_", " "))

    def with_horizon(self, horizon: int) -> Task:
        """The task with another horizon in frames."""
        longer = copy(self)
        longer.horizon = horizon
        return longer

    def frames(self, seconds: float) -> int:
        """The number of frames in a duration in s, at least one."""
        return max(1, round(seconds / self.time_step))

    def draw_start(self, rng: np.random.Generator) -> Array:
        """A random start (n,): start_mean + N(0, start_deviation^2) (Section VI-A)."""
        return self.start_mean + self.start_deviation * rng.standard_normal(len(self.states))


@final
class WithoutTargets(Task):
    """A task without targets: with the states, starts and failures of the robot, but no goal."""

    goals = ()  # the goal depends on targets

    def __init__(self, task: Task) -> None:
        self._task, n = task, len(task.states) - len(task.targets)
        self.states = self.outputs = task.states[:n]
        self.inputs, self.criteria, self.pushes = task.inputs, task.criteria, task.pushes
        self.joints = task.joints
        self.time_step, self.horizon, self.input_limit = task.time_step, task.horizon, task.input_limit
        self.start_mean, self.start_deviation = task.start_mean[:n], task.start_deviation[:n]
        self._means = task.start_mean[n:]  # of the targets, on which no failure depends

    @property
    def input_bounds(self) -> tuple[Array, Array]:
        """Lower and upper limits (m,) of the inputs."""
        return self._task.input_bounds

    def aim(self, x: Array) -> Array:
        """An empty array (..., 0), since there is no goal."""
        return x[..., :0]

    def measure(self, x: Array) -> Array:
        """Measures (..., c) of the failure criteria at the robot's states x (..., n)."""
        means = np.broadcast_to(self._means, (*x.shape[:-1], len(self._means)))
        return self._task.measure(np.concatenate([x, means], axis=-1))

    def output(self, x: Array) -> Array:
        """The robot's states (..., n): a policy's outputs may depend on targets."""
        return x

    def draw_start(self, rng: np.random.Generator) -> Array:
        """A random start (n,) of the robot."""
        return self._task.draw_start(rng)[: len(self.states)]


class Hardware(ABC):
    """The expensive system, on which experiments are made."""

    sets_start: bool = True  #: whether an experiment begins at the requested start; else where the robot is

    @cached_property  # so that an instance may set it
    def concurrent(self) -> bool:
        """Whether trials may run at the same time, in processes that may be killed; not if `stop` has to act.

        A class or an instance whose `stop` ends a simulation sets `concurrent = True`.
        """
        return type(self).stop is Hardware.stop

    @abstractmethod
    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """Run one experiment with theta (p,); the rollout's cost and parameters are not set.

        It begins at the start (n,), or as near to it as the robot can get; the rollout's first state is the
        actual start. `policy.controller(theta, time_step)` computes the input of each frame, also from a list
        of numbers. Any other error than those below, or a result that is not a rollout of the task, ends the
        trial with a one-line message, and the result is kept. Once the hardware is mended, the same command
        resumes the trial (`simbias.lab.checked_hardware`).

        Raises
        ------
        HardwareError
            If the experiment could not be carried out.
        ConfigError
            If the file that a person provided for it is bad input.
        Waiting
            If the result is not there yet. The next start requests the same experiment again.
        """

    def stop(self) -> None:  # noqa: B027  (few need it)
        """Bring the system to rest: an experiment took too long, was interrupted or went beyond a limit.

        With `experiment_timeout` it is called from another thread while `run` still runs. `run` should then
        end soon; its result or error is ignored. Beyond a limit of `hardware.safety`, `run` has already ended
        by the controller's exception. By default nothing happens.
        """
