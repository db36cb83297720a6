"""A Gymnasium environment instead of the robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, final

import numpy as np
from pydantic import Field

from simbias.core import Hardware, Policy, Task
from simbias.core.extras import library
from simbias.core.messages import quote, words
from simbias.core.records import Array, Rollout
from simbias.robots.mujoco.parameters import Factors, Values, changes, put_values
from simbias.simulation.compiler import Expression, Expressions
from simbias.simulation.control_loop import Record, Robot, experiment
from simbias.simulation.noise import QUIET, Noise, Variances

TERMINATED = "terminated"  # a failure that only the environment detects
ExpressionList = Annotated[list[Expression], Field(min_length=1)]


@dataclass(frozen=True)
class Start:
    """Expressions of the task's states that set an environment to a start.

    MuJoCo environments have positions and velocities; those of classic control have a state.
    """

    qpos: ExpressionList | None = None
    qvel: ExpressionList | None = None
    state: ExpressionList | None = None


@final
class Gymnasium(Hardware):
    """An environment, by its id. Its `terminated` is a failure, in addition to those of the task.

    Rewards are ignored, and nothing is truncated: the task's horizon applies.

    Parameters
    ----------
    environment
        Its id, as in `gymnasium.make`.
    options
        Additional arguments of the environment.
    states
        The task's states by name, as expressions of `observation[0]` and so on; by default the observation.
    action
        The components of the action, as expressions of the task's inputs; by default the inputs.
    start
        Sets the environment to a start. Without it, an experiment begins at the state after `reset`.
    values, factors
        For MuJoCo environments: physical parameters to set, and factors to multiply them by, by name
        (`simbias.robots.mujoco.parameters`).
    noise
        Variances of noise on the inputs and on the states that the policy sees, by name (`Noise`).
    record
        The states used by cost and learning: the true or the measured ones.

    Raises
    ------
    ValueError
        If Gymnasium is not installed, or the environment does not fit the task.
    """

    def __init__(
        self,
        task: Task,
        environment: str,
        options: dict[str, Any] | None = None,
        states: dict[str, Expression] | None = None,
        action: ExpressionList | None = None,
        start: Start | None = None,
        values: Values | None = None,
        factors: Factors | None = None,
        noise: Variances = QUIET,
        record: Record = "true_state",
    ) -> None:
        self._task = task
        self._noise = Noise(task, noise)
        self._record = record
        self._environment = _make(environment, options or {})
        own = self._environment.unwrapped
        self.simulates = type(own).__module__.partition(".")[0] == "gymnasium"  # others may drive robots
        if values or factors:
            if not hasattr(getattr(own, "model", None), "body_mass"):
                raise ValueError(f"values and factors: {environment} is not a MuJoCo environment")
            put_values(own.model, changes(own.model, values or {}, factors or {}))
        step = getattr(own, "dt", getattr(own, "tau", task.time_step))
        if not np.isclose(step, task.time_step, rtol=1e-6):
            raise ValueError(
                f"a step of {environment} takes {step:g} s; task.time_step is {task.time_step:g} s"
            )
        self._states = self._state_expressions(environment, states)
        self._action = _Action(self._environment.action_space, task, action, environment)
        self._environment.reset(seed=0)  # some have no state before a reset
        self._start = _start(own, task, start, environment)
        self.sets_start = self._start is not None

    def _state_expressions(self, name: str, states: dict[str, str] | None) -> Expressions:
        """The task's states as expressions of an observation."""
        shape = self._environment.observation_space.shape
        if shape is None or len(shape) != 1:
            raise ValueError(
                f"an observation of {name} is not a vector, but {self._environment.observation_space}"
            )
        seen = [f"observation[{index}]" for index in range(shape[0])]
        names = [state.name for state in self._task.states]
        if states is None:
            if len(seen) != len(names):
                raise ValueError(
                    f"an observation of {name} has {len(seen)} numbers; the task has {len(names)} states"
                )
            states = dict(zip(names, seen, strict=True))
        if set(states) != set(names):
            raise ValueError(f"states: expected {', '.join(names)}, got {', '.join(states)}")
        return Expressions({name: states[name] for name in names}, seen)

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """Run one experiment with theta (p,); the rollout's first state is its actual start."""
        noise = self._noise.draw(rng)
        observation, _ = self._environment.reset(seed=int(rng.integers(2**31)))
        x = self._states(np.asarray(observation, dtype=np.float64))
        if self._start is not None:
            self._start(start)
            x = start
        robot = _Running(self._task, self._environment, self._states, self._action, x)
        return experiment(self._task, robot, policy, theta, noise, self._record)


class _Action:
    """Maps an input (m,) to an action of the environment."""

    def __init__(self, space: Any, task: Task, action: list[str] | None, environment: str) -> None:
        names = [each.name for each in task.inputs]
        texts = {f"action[{i}]": text for i, text in enumerate(action or names)}
        self._expressions = Expressions(texts, names)
        self._discrete = hasattr(space, "n") and hasattr(space, "start")  # MultiBinary has no `start`
        if self._discrete:
            self._low = np.array([space.start], np.float64)
            self._high = self._low + (space.n - 1)
        else:
            if not hasattr(space, "low") or len(space.shape) != 1:
                raise ValueError(
                    f"an action of {environment} is neither a vector nor a discrete choice, but {space}"
                )
            self._low, self._high = (np.asarray(b, dtype=np.float64) for b in (space.low, space.high))
        if len(texts) != len(self._low):
            has = f"an action of {environment} has {len(self._low)} numbers"
            raise ValueError(f"{has}; the config gives {len(texts)}")
        for u in task.input_bounds:
            asked = self._expressions(u)
            if (asked < self._low - 1e-6).any() or (asked > self._high + 1e-6).any():
                raise ValueError(
                    f"at the input {u.tolist()} the action is {asked.tolist()}; {environment} takes "
                    f"{self._low.tolist()} to {self._high.tolist()}"
                )

    def __call__(self, u: Array) -> Any:
        """The action, with noise, clipped to the limits, as by the environment's motors."""
        action = np.clip(self._expressions(u), self._low, self._high)
        return round(float(action[0])) if self._discrete else action


@dataclass(eq=False)
class _Running(Robot):
    """A running experiment in the environment."""

    task: Task
    environment: Any
    states: Expressions
    action: _Action
    x: Array  # (n,)
    terminated: bool = False

    def state(self) -> Array:
        """The state (n,)."""
        return self.x

    def step(self, u: Array) -> None:
        """One step under the input u (m,)."""
        observation, _, self.terminated, _, _ = self.environment.step(self.action(u))
        self.x = self.states(np.asarray(observation, dtype=np.float64))

    def failure(self) -> str | None:
        """The violated criterion of the task, or `terminated`."""
        return self.task.failure(self.x) or (TERMINATED if self.terminated else None)


def _make(name: str, options: dict[str, Any]) -> Any:
    gymnasium = library("gymnasium", "Gymnasium", "gymnasium")
    if ":" in name:  # its first part would be imported
        raise ValueError(f"{quote(name)} names a module; only registered environments can be used")
    try:
        return gymnasium.make(name, max_episode_steps=-1, disable_env_checker=True, **options)
    except gymnasium.error.UnregisteredEnv as error:
        hint = "If it is your own, call gymnasium.register in the module of one of your components."
        raise ValueError(f"{quote(name)}: {words(error)} {hint}") from error
    except Exception as error:  # also an environment's own errors
        raise ValueError(f"{quote(name)}: {words(error)}") from error


def _start(own: Any, task: Task, start: Start | None, name: str) -> Any:
    """A function that sets the environment to a start (n,); None if nothing is declared."""
    if start is None:
        return None
    names = [state.name for state in task.states]

    def expressions(name: str, texts: list[str]) -> Expressions:
        return Expressions({f"start.{name}[{i}]": text for i, text in enumerate(texts)}, names)

    if start.qpos and start.qvel and start.state is None and hasattr(own, "set_state"):
        qpos, qvel = expressions("qpos", start.qpos), expressions("qvel", start.qvel)
        sizes = (own.model.nq, own.model.nv)
        if (len(start.qpos), len(start.qvel)) != sizes:
            raise ValueError(f"start: {name} has {sizes[0]} positions and {sizes[1]} velocities")
        return lambda x: own.set_state(qpos(x), qvel(x))
    if start.state and start.qpos is None and start.qvel is None and hasattr(own, "state"):
        if len(start.state) != (size := np.size(own.state)):
            raise ValueError(f"start: the state of {name} has {size} numbers, got {len(start.state)}")
        state = expressions("state", start.state)
        return lambda x: setattr(own, "state", state(x))
    given = ", ".join(key for key, texts in vars(start).items() if texts)
    raise ValueError(
        f"start: {name} cannot be set by {given}" if given else "start: no expressions are given"
    )
