"""A task declared in YAML, without Python code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from simbias.core import Quantity, Task
from simbias.core.files import ConfigFile
from simbias.core.ranges import Coordinate, Frames, Seconds, TimeStep
from simbias.core.records import Array
from simbias.core.task_checks import check_quantities, drawn_starts, varied_states
from simbias.robots.declared.declarations import (
    DrawnPart,
    Failure,
    Input,
    Named,
    Output,
    Pulses,
    bounds_of,
    check_units,
    criterion_of,
    measure_of,
    push_of,
)
from simbias.robots.declared.reach import warn_out_of_reach
from simbias.robots.declared.reference import (
    Reference,
    check_jumps,
    check_rows,
    check_within,
    warn_of_degrees,
)
from simbias.robots.declared.starts import Starts, State
from simbias.robots.declared.success import Success, success_names
from simbias.robots.declared.turns import warn_of_turns
from simbias.robots.mujoco.figure import Figure, FigureFile
from simbias.robots.mujoco.rendering import Image
from simbias.robots.mujoco.sensors import SensorFile, Sensors
from simbias.simulation.compiler import Expression, Expressions


class Declared(Task):
    """Reach a goal, or stay within the failure criteria for `horizon` frames of `time_step` seconds.

    Expressions follow `simbias.simulation.compiler.expressions`. They use the states and the names defined by
    `constants` and `where`.

    Parameters
    ----------
    states, inputs
        By name, in the order of x and u; targets come after the states.
    outputs
        The quantities that a policy feeds back, in the order of z; by default all states.
    failure
        Criteria by name; if several are violated, the first one counts. Without criteria, nothing fails.
    goal
        Reference values of states and outputs, by name: expressions of time t in s and of targets. By default
        zero for all states.
    reference
        Instead of a goal: a CSV file with columns t and names, linearly interpolated between rows.
    success
        Conditions by name, which must all hold for the last `hold` seconds of a successful episode. Besides
        states, they may use t and the error of each goal quantity, such as `angle_error`. Without conditions,
        the cost decides.
    starts
        A list of starts, one of which is drawn for each episode, instead of the states' means. The first is
        the mean start.
    pushes
        Pushes by the inputs' names.
    where
        Expressions by name; each may use earlier ones.
    drawing
        Parts by name, from back to front, all lengths in one unit, y upwards.
    figure
        The file of a MuJoCo model, whose geoms are drawn or rendered instead of the parts of `drawing` that
        move with the robot. Other parts, such as a target, stay behind them.
    targets
        By name, like states: drawn with each start, constant, and known. Expressions may use them; failure
        criteria may not, as the robot itself has no targets.
    sensors
        The file of a MuJoCo model whose sensors and site positions expressions may also use: a number by its
        name, a vector as `tip[0]`. The engine computes them, so rollouts are simulated in NumPy.
    """

    def __init__(
        self,
        states: Named[State],
        inputs: Named[Input],
        time_step: TimeStep,
        horizon: Frames,
        failure: Named[Failure] | None = None,
        outputs: Named[Output] | None = None,
        constants: Named[Coordinate] | None = None,
        where: Named[Expression] | None = None,
        drawing: Named[DrawnPart] | None = None,
        figure: FigureFile | None = None,
        goal: Named[Expression] | None = None,
        reference: ConfigFile | None = None,
        success: Named[Failure] | None = None,
        hold: Seconds | None = None,
        starts: Annotated[list[list[Coordinate]], Field(min_length=1)] | None = None,
        pushes: Named[Pulses] | None = None,
        sensors: SensorFile | None = None,
        targets: Named[State] | None = None,
    ) -> None:
        for name, some in (("states", states), ("inputs", inputs)):
            if not some:
                raise ValueError(f"{name} is empty: declare at least one")
        self.time_step, self.horizon = time_step, horizon
        self.criteria, self.outputs = (), ()  # not yet needed for checks of a robot's file
        self._set_states(dict(states), dict(targets or {}), starts)
        self._set_inputs(dict(inputs))
        self._sensors = None if sensors is None else Sensors(self.without_targets, sensors)
        sensed, self.joints = (self._sensors.names, (self._sensors.joints,)) if self._sensors else ((), ())
        self._known: dict[str, Any] = {
            "variables": (*(each.name for each in self.states), *sensed),
            "constants": dict(constants or {}),
            "where": dict(where or {}),
        }
        self._set_outputs(dict(outputs or {}))
        self._set_failures(dict(failure or {}))
        self._set_goal(dict(goal or {}), reference)
        check_quantities(self)  # first, as errors of angles need a turn
        self._set_success(dict(success or {}), hold, dict(failure or {}))
        self._warn_of_turns(dict(failure or {}), dict(success or {}))
        names = tuple(each.name for each in self.inputs)
        self.pushes = tuple(
            push_of(name, each, names, time_step) for name, each in dict(pushes or {}).items()
        )
        self._figure = None if figure is None else Figure(self.without_targets, figure)
        self.joints += (self._figure.joints,) if self._figure else ()
        self.source_files = [
            file for part in (self._figure, self._sensors) if part for file in part.source_files
        ]
        self.source_files += [Path(reference)] if reference else []
        self._set_drawing(dict(drawing or {}))

    def _set_states(
        self, robot: dict[str, State], targets: dict[str, State], starts: list[list[float]] | None
    ) -> None:
        """Set the states, the last of which are targets, and their starts."""
        for name in set(robot) & set(targets):
            raise ValueError(f"targets.{name}: a state already has this name")
        states = {**robot, **targets}
        self.states = tuple(
            Quantity(name, state.unit, state.kind, state.wraps) for name, state in states.items()
        )
        self.targets = self.states[len(robot) :]
        keyed = {f"states.{name}": state for name, state in robot.items()}
        self._starts = Starts(keyed | {f"targets.{name}": state for name, state in targets.items()}, starts)
        self.start_mean, self.start_deviation = self._starts.mean, self._starts.deviation

    def _set_inputs(self, inputs: dict[str, Input]) -> None:
        self.inputs = tuple(Quantity(name, each.unit, each.kind) for name, each in inputs.items())
        self._input_bounds = lower, upper = bounds_of(inputs)
        self.input_limit = np.maximum(-lower, upper)

    def _set_outputs(self, outputs: dict[str, Output]) -> None:
        given = outputs or {state.name: Output(state.name, state.unit) for state in self.states}
        self.outputs = tuple(Quantity(name, output.unit) for name, output in given.items())
        self._output = self.expressions({f"outputs.{name}": output.value for name, output in given.items()})

    def _set_failures(self, failure: dict[str, Failure]) -> None:
        """Set the failure criteria; refuse those that depend on targets, which a robot does not have."""
        names = tuple(each.name for each in self.states[: len(self.states) - len(self.targets)])
        self.criteria = tuple(criterion_of(name, each, names) for name, each in failure.items())
        self._measure = self._measures("failure", failure, self._known["variables"])
        check_units("failure", failure, {each.name: each.unit for each in self.states})
        x = self.start_mean.copy()
        x[len(x) - len(self.targets) :] = np.nan
        for criterion, measure in zip(self.criteria, self.measure(x) if self.targets else (), strict=False):
            if np.isnan(measure):
                raise ValueError(f"failure.{criterion.name}: a robot's failure cannot depend on targets")
        for key, start in self._starts.means.items():
            if failure_there := self.failure(start):
                raise ValueError(f"{key}: the task fails at its start: {failure_there}")

    def _set_drawing(self, drawing: dict[str, DrawnPart]) -> None:
        """Set the drawing: the declared parts; a figure replaces those that move with the robot."""
        self._declared = self.drawing = drawing
        self._points = self.expressions(
            {
                f"drawing.{name}.{index}.{axis}": expression
                for name, part in drawing.items()
                for index, point in enumerate(part.points)
                for axis, expression in zip("xy", point, strict=True)
            }
        )
        if self._figure:
            x = self.start_mean.copy()
            self._of_robot(x)[:] = np.nan
            still = [name for name, points in self._placed(x).items() if np.isfinite(points).all()]
            own = {name: DrawnPart([], thickness) for name, thickness in self._figure.thickness.items()}
            self.drawing = {name: drawing[name] for name in still} | own

    def _set_goal(self, goal: Mapping[str, str], file: str | None) -> None:
        if goal and file:
            raise ValueError("give only one of goal and reference")
        self._reference, self._goals = None, self.states
        if not goal and file is None:
            if self.targets:
                raise ValueError("targets: a goal, or outputs of a goal, must depend on them")
            return
        means = dict(zip((each.name for each in self.targets), self.targets_in(self.start_mean), strict=True))
        seconds = self.horizon * self.time_step
        self._reference = Reference(goal, file, self._known["constants"], seconds, means)
        known = {quantity.name: (i, quantity) for i, quantity in enumerate((*self.states, *self.outputs))}
        known |= {state.name: (i, state) for i, state in enumerate(self.states)}
        for name in self._reference.names:
            if name not in known:
                raise ValueError(f"goal: no state or output is called {name}; available: {', '.join(known)}")
            self._check_meant(name)
        aimed = [known[name] for name in self._reference.names]
        self._aimed, self._goals = [index for index, _ in aimed], tuple(quantity for _, quantity in aimed)
        if self.criteria:
            variables = self._known["variables"]
            drawn = drawn_starts(self, np.random.default_rng(0)) if self.targets else np.empty((0, 0))
            check_within(
                self._reference, variables, self.criteria, self._measure, seconds, self.targets_in(drawn)
            )
        warn_of_degrees(self._reference, self._goals, seconds)
        check_jumps(self._reference, self._goals, self.time_step)
        if file is not None:
            check_rows(self._reference, self._goals, file, self.time_step)

    def _check_meant(self, name: str) -> None:
        """Refuse a goal's name that a state and an output have if their values differ."""
        states, outputs = ([each.name for each in some] for some in (self.states, self.outputs))
        if name in states and name in outputs:
            x = drawn_starts(self, np.random.default_rng(0))
            own, other = x[:, states.index(name)], self.output(x)[:, outputs.index(name)]
            if not np.allclose(own, other):
                raise ValueError(f"goal.{name}: a state and an output with other values have this name")

    def _set_success(
        self, success: Mapping[str, Failure], hold: float | None, failure: Mapping[str, Failure]
    ) -> None:
        self._success = None
        if bool(success) != (hold is not None):
            raise ValueError("give success and hold together")
        if not success or hold is None:
            return
        if hold > self.horizon * self.time_step:
            raise ValueError(
                f"hold is {hold:g} s, but an episode {self.horizon * self.time_step:g} s: none can succeed"
            )
        names = success_names(self._known["variables"], self._goals)
        measures = self._measures("success", success, names)
        units = {each.name: each.unit for each in self.states}
        check_units("success", success, units | {f"{goal.name}_error": goal.unit for goal in self._goals})
        self._success = Success(success, measures, self.frames(hold) + 1, hold)
        times = self._success.times(self)
        errors = np.zeros((len(times), len(self._goals)))
        states = np.full((len(times), len(self._known["variables"])), np.nan)
        self._success.check_at(np.column_stack([states, times, errors]))
        self._success.check_beside(failure)
        self._success.warn_of_degrees(self._goals)
        x = varied_states(self)
        t = np.linspace(0.0, self.horizon * self.time_step, len(x))
        errors = np.random.default_rng(0).standard_normal((len(x), len(self._goals)))
        self._success.check_numbers(self._seen(x), t, errors)
        warn_out_of_reach(self, self._success, self._seen, slow=self._sensors is not None)
        for key, start in self._starts.means.items() if len(times) > self.horizon else ():
            if not self.succeeds(start[None]):
                raise ValueError(
                    f"{key}: hold is a whole episode, but {self.missed(start[None])} at its start"
                )

    def _warn_of_turns(self, failure: Mapping[str, Failure], success: Mapping[str, Failure]) -> None:
        """Warn if a condition counts the turns of an angle; a failure's `abs` of an angle may mean to."""
        conditions = {f"success.{name}": each for name, each in success.items()}
        for criterion, each in zip(self.criteria, failure.values(), strict=True):
            if not criterion.bounds:
                conditions[f"failure.{criterion.name}"] = each
        warn_of_turns(self, self._known["where"], conditions, self._measure_alone)

    def _measure_alone(self, index: int, values: Array) -> Array:
        """Measures (k, c) of failure at values (k,) of one state; nan if they depend on others, too."""
        x = np.full((len(values), len(self._known["variables"])), np.nan)
        x[:, index] = values
        return self._measure(x)

    def _measures(self, key: str, conditions: Mapping[str, Failure], names: Sequence[str]) -> Expressions:
        """Measures that exceed the limits of conditions if these hold."""
        known, each = {**self._known, "variables": names}, conditions.items()
        Expressions({f"{key}.{name}": condition.value for name, condition in each}, **known)  # may raise
        signed = {f"{key}.{name}": measure_of(f"{key}.{name}", condition) for name, condition in each}
        return Expressions(signed, **known)

    @property
    def input_bounds(self) -> tuple[Array, Array]:
        """Lower and upper limits (m,) of the inputs."""
        return self._input_bounds

    def measure(self, x: Array) -> Array:
        """Measures (..., c) of the failure criteria at states x (..., n)."""
        return self._measure(self._seen(x)) if self.criteria else x[..., :0]

    def output(self, x: Array) -> Array:
        """Outputs z (..., q) at states x (..., n)."""
        return self._output(self._seen(x))

    def _seen(self, x: Array) -> Array:
        """States (..., n), followed by sensor values of the robot's states."""
        if self._sensors is None:
            return x
        return np.concatenate([x, self._sensors(self._of_robot(x))], axis=-1)

    def _of_robot(self, x: Array) -> Array:
        """The robot's states among x (..., n)."""
        return x[..., : len(self.states) - len(self.targets)]

    def draw_start(self, rng: np.random.Generator) -> Array:
        """A random start (n,)."""
        return self._starts.draw(rng)

    @property
    def goals(self) -> tuple[Quantity, ...]:
        """The quantities in which the goal is stated."""
        return self._goals

    def aim(self, x: Array) -> Array:
        """The goal's quantities (..., g) at states x (..., n)."""
        if self._goals is self.states:
            return x
        return np.concatenate([x, self.output(x)], axis=-1)[..., self._aimed]

    def reference(self, t: Any, targets: Array | None = None) -> Array:
        """Reference values (..., g) or (g,) of the goal's quantities at times t (...) in s.

        They may depend on targets (..., k); None: their means.
        """
        return super().reference(t) if self._reference is None else self._reference(t, targets)

    def succeeds(self, states: Array) -> bool | None:
        """Whether an episode of states (T+1, n) that has not failed succeeds; None without conditions."""
        return None if self._success is None else self._success.holds(*self._episode(states))

    def uptime(self, states: Array) -> float:
        """The share of the horizon in which an episode of states (T+1, n) meets the conditions of success."""
        if self._success is None:
            return super().uptime(states)
        return self._success.share(*self._episode(states)) * len(states) / (self.horizon + 1)

    def shortfalls(self, states: Array) -> Array:
        """How far (T+1, k) states (T+1, n) are from each condition of success that an episode misses."""
        if self._success is None:
            return super().shortfalls(states)
        return self._success.shortfalls(*self._episode(states))

    def missed(self, states: Array) -> str:
        """How an episode of states (T+1, n) misses the conditions of success, in words."""
        if self._success is None:
            return super().missed(states)
        return self._success.missed(*self._episode(states))

    def _episode(self, states: Array) -> tuple[Array, Array, Array]:
        """States (T+1, n) with sensor values, their times, and errors."""
        times = self.time_step * np.arange(len(states), dtype=np.float64)
        return self._seen(states), times, self.error(states, times)

    def points(self, x: Array) -> dict[str, Array]:
        """The points (k, 2) of every part of the drawing at the state x (n,)."""
        placed = self._placed(x) | (self._figure.points(self._of_robot(x)) if self._figure else {})
        return {name: placed[name] for name in self.drawing}

    def _placed(self, x: Array) -> dict[str, Array]:
        """The points (k, 2) of every declared part at the state x (n,)."""
        points = self._points(self._seen(x)).reshape(-1, 2)
        ends = np.cumsum([len(part.points) for part in self._declared.values()])
        return dict(zip(self._declared, np.split(points, ends), strict=False))

    def image(self, x: Array) -> Image | None:
        """The image of the state x (n,) rendered by MuJoCo; None if the drawing consists of parts."""
        return self._figure.image(self._of_robot(x)) if self._figure else None

    def expressions(self, expressions: Mapping[str, str]) -> Expressions:
        """Expressions of the states and the other names defined here; ValueError if one is not allowed."""
        return Expressions(expressions, **self._known)
