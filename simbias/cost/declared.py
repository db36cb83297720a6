"""A cost that is declared in YAML."""

from __future__ import annotations

import ast
import unicodedata
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np

from simbias.core import Cost, StudyWarning, Task
from simbias.core.ranges import Coordinate, Positive
from simbias.core.records import Array, Indices, Rollout
from simbias.core.task_checks import varied_states
from simbias.simulation.compiler import Expression, Expressions
from simbias.simulation.linearization import input_scale

NAMES = "running", "peak", "final"  # of the expressions
LARGEST = 1e100  # of a sum, if a simulated state overflows, or an expression is not finite


@final
class Declared(Cost):
    """Z = c (T - t_fail) / T + sum of `running` / T + the largest `peak`, if positive, + the last `final`.

    `final` counts at the horizon only, so a rollout that fails is without it: choose c larger than what the
    other terms can cost.

    Expressions follow `simbias.simulation.compiler.expressions`. They may use states, inputs, the time t in
    s, the error of each goal quantity, such as `angle_error`, and constants. An expression that is not finite
    in a finite state, such as the root of a negative number, gets the largest cost there.

    Parameters
    ----------
    failure_weight
        c, the cost of a rollout that fails at once.
    """

    reductions = ("sum", "max", "sum")

    def __init__(
        self,
        task: Task,
        max_cost: Positive,
        failure_weight: Positive,
        running: Expression = "0",
        peak: Expression = "0",
        final: Expression = "0",
        constants: dict[str, Coordinate] | None = None,
    ) -> None:
        self.max_cost = max_cost
        self.horizon, self.time_step = task.horizon, task.time_step
        self._task, self._failure_weight = task, failure_weight
        quantities = [each.name for each in (*task.states, *task.inputs)]
        names = [*quantities, "t", *(f"{goal.name}_error" for goal in task.goals)]
        texts = dict(zip(NAMES, (running, peak, final), strict=True))
        self._expressions = Expressions(texts, names, constants)
        self._check(texts, names)

    def _check(self, texts: Mapping[str, str], names: Sequence[str]) -> None:
        """Refuse an expression that is not finite in any of many states; warn if all are constant."""
        x = varied_states(self._task)
        t = np.linspace(0.0, self.horizon * self.time_step, len(x))
        scale, (lower, upper) = input_scale(self._task), self._task.input_bounds
        lower, upper = np.maximum(lower, -scale), np.minimum(upper, scale)
        u = np.random.default_rng(0).uniform(lower, upper, (len(x), len(scale)))
        values = self._expressions(np.column_stack([x, u, t, self._task.error(x, t)]))
        for name, each in zip(texts, values.T, strict=True):
            if not np.isfinite(each).any():
                raise ValueError(f"{name} is not finite in any of {len(x)} states")
        used = {unicodedata.normalize("NFKC", name) for name in names}  # as in Python's expressions
        parts = (part for text in texts.values() for part in ast.walk(ast.parse(text.strip())))
        if {part.id for part in parts if isinstance(part, ast.Name)}.isdisjoint(used):
            words = "the cost is constant: policies differ only by when they fail"
            warnings.warn(words, StudyWarning, stacklevel=3)

    def terms(self, x_next: Array, u: Array, t: Any) -> Array:
        """The values (..., 3) of the expressions in each frame."""
        e = self._task.error(x_next, t)
        values = self._expressions(np.concatenate([x_next, u, np.stack([t], axis=-1), e], axis=-1))
        running, peak, final = np.moveaxis(np.where(np.abs(values) < np.inf, values, LARGEST), -1, 0)
        ends = 1.0 * (t > (self.horizon - 0.5) * self.time_step)
        # One value per frame, even for constants; nan in a frame that ends in a non-finite state.
        each = 0.0 * (t + np.sum(x_next, axis=-1))
        return np.stack([running + each, peak + each, ends * final + each], axis=-1)

    def oddity(self, rollout: Rollout) -> tuple[str, str] | None:
        """An oddity if an expression is not finite along a rollout: the first such expression, and when."""
        t = self.time_step * np.arange(1, rollout.frames + 1)
        with np.errstate(over="ignore", invalid="ignore"):
            terms = self.terms(rollout.states[1:], rollout.inputs, t)
        for frame, column in np.argwhere(terms >= LARGEST)[:1]:
            return "a cost is no number", (
                f"cost.{NAMES[column]} is not finite at t = {t[frame]:.3g} s of this policy's simulation, so "
                f"it counts as {LARGEST:g}: every policy may cost the same"
            )
        return None

    def of_totals(self, totals: Array, lost: Indices) -> Array:
        """Z (...) of sums and peaks (..., 3) and the frames (...) lost by failure."""
        mean, peak, final = np.moveaxis(np.clip(totals, -LARGEST, LARGEST), -1, 0)
        return (self._failure_weight * lost + mean) / self.horizon + peak + final
