"""Plans on a model by multiple shooting, with CasADi and IPOPT.

CasADi gets the model's formulas from the compiler's trace, and so exact second derivatives. MuJoCo's engine
has no formulas: its slopes are differences, with sliding joints, as for iterative LQR, and the curvature is
that of the cost alone (Gauss-Newton).
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import casadi
import numpy as np

from simbias.core import GoalWeights, Nominal, Task
from simbias.core.records import Array
from simbias.search.optimizer.following import STEP, Plan
from simbias.search.optimizer.ilqr import SHARE
from simbias.simulation.compiler.symbolic_arrays import row, symbols_in
from simbias.simulation.compiler.symbols import Trace
from simbias.simulation.compiler.written import needed
from simbias.simulation.goal import goal_along
from simbias.simulation.linearization import derivatives

ROWS, AGREES = 100, 1e-12  # random states at which formulas are compared, and their relative difference
IPOPT = {"print_level": 0, "sb": "yes", "max_iter": 500, "max_cpu_time": 60.0, "tol": 1e-6}
IPOPT["mu_strategy"] = "adaptive"  # monotone: 15 times slower on the quadrotor
OPERATIONS: dict[str, Any] = {name: getattr(operator, name[:3]) for name in ("add", "subtract", "multiply")}
OPERATIONS |= {"divide": operator.truediv, "negative": operator.neg, "inverse": lambda a: 1.0 / a}
OPERATIONS |= {"less": operator.lt, "less_equal": operator.le, "angle": lambda a: a, "indicator": lambda a: a}
NAMES = {"abs": "fabs", "arctan2": "atan2", "chosen": "if_else", "minimum": "fmin", "at_most": "fmin"}
NAMES |= {"maximum": "fmax", "at_least": "fmax"}  # of other operations in CasADi


def translated(method: Any, *sizes: int) -> Any:
    """A method of vectors (1, size) as a CasADi function of one vector, in which they follow each other.

    TypeError if the method cannot be traced.
    """
    trace = Trace()
    rows = [row(trace, f"v{index}", size) for index, size in enumerate(sizes)]
    results = symbols_in(method(*rows), trace)[0]
    if trace.functions:
        raise TypeError("an engine's step has no formula")
    v = casadi.SX.sym("v", sum(sizes))
    given = [symbol.index for each in rows for symbol in each[0]]
    values = dict(zip(given, casadi.vertsplit(v), strict=True))
    for symbol in needed(trace, [results], values):
        if symbol.name == "number":
            values[symbol.index] = casadi.SX(symbol.value)
        else:
            operation = OPERATIONS.get(symbol.name) or getattr(casadi, NAMES.get(symbol.name, symbol.name))
            values[symbol.index] = operation(*(values[operand.index] for operand in symbol.operands))
    made = casadi.Function("made", [v], [casadi.vertcat(*(values[symbol.index] for symbol in results))])
    points = np.random.default_rng(0).standard_normal((ROWS, sum(sizes)))
    expected = method(*np.split(points, np.cumsum(sizes)[:-1], axis=1))
    if not np.allclose(made(points.T).full().T, expected, rtol=AGREES, atol=AGREES):
        raise ValueError(f"CasADi gives other numbers than {method}")
    return made


class Frames(casadi.Callback):
    """A NumPy function of the states and inputs of all frames (T, n+m), and its slopes."""

    def __init__(self, function: Callable, given: list[Any], made: Any, slopes: Frames | None = None) -> None:
        super().__init__()
        self._function, self._given, self._made, self._slopes = function, given, made, slopes
        self.construct("frames", {})

    def get_n_in(self) -> int:
        return len(self._given)

    def get_sparsity_in(self, index: int) -> Any:
        return self._given[index]

    def get_sparsity_out(self, index: int) -> Any:
        return self._made

    def eval(self, arguments: Sequence[Any]) -> list[Any]:
        return [casadi.DM(self._made, self._function(arguments[0].full().T).ravel())]

    def has_jacobian(self) -> bool:
        return self._slopes is not None

    def get_jacobian(self, *options: Any) -> Any:
        return self._slopes

    def has_jac_sparsity(self, *indices: int) -> bool:
        return self._slopes is not None

    def get_jac_sparsity(self, *options: Any) -> Any:
        return self._slopes._made


def engine_steps(nominal: Nominal, task: Task) -> Frames:
    """The engine's steps of all frames, from (n+m, T) to (n, T); slopes are those of sliding joints."""
    n, both, T = len(task.states), len(task.states) + len(task.inputs), task.horizon

    def step(nominal: Nominal, points: Array) -> Array:
        return nominal.step(points[..., :n], points[..., n:])

    def slopes(points: Array) -> Array:
        steps = STEP * np.concatenate([np.ones(n), task.input_limit])
        return derivatives(partial(step, nominal.without_dry_friction()), points, steps).swapaxes(1, 2)

    dense = casadi.Sparsity.dense
    blocks, given = casadi.diagcat(*[dense(n, both)] * T), dense(both, T)
    jacobian = Frames(slopes, [given, casadi.Sparsity(n, T)], blocks)
    return Frames(partial(step, nominal), [given], dense(n, T), jacobian)


class MultipleShooting:
    """Plans by IPOPT; its variables are the states and inputs of all frames."""

    def __init__(self, task: Task, nominal: Nominal, weights: GoalWeights) -> None:
        n, m, T = len(task.states), len(task.inputs), task.horizon
        V, last = casadi.MX.sym("V", n + m, T), casadi.MX.sym("last", n)
        variables, X = casadi.veccat(V, last), casadi.horzcat(V[:n, :], last)
        W = np.tile(np.sqrt(task.time_step * weights.errors), (T + 1, 1))
        W[-1] = np.sqrt(weights.final)
        R = np.tile(np.sqrt(task.time_step * weights.inputs), (T, 1))
        errors = translated(task.aim, n).map(T + 1)(X) - goal_along(task).T
        squared = casadi.veccat(W.T * errors, R.T * V[n:, :])
        options: dict[str, Any] = {"print_time": False, "ipopt": IPOPT}
        try:
            self._steps = translated(nominal.step, n, m).map(T)
        except TypeError:  # it cannot be traced
            self._steps = engine_steps(nominal, task)  # kept alive
            slopes, parameters = casadi.jacobian(squared, variables), casadi.MX.sym("p", 0, 0)
            factor = casadi.MX.sym("factor"), casadi.MX.sym("multipliers", T * (n + len(task.criteria)))
            hessian = casadi.triu(factor[0] * (slopes.T @ slopes))
            options["hess_lag"] = casadi.Function("hess_lag", [variables, parameters, *factor], [hessian])
        defects, measures = X[:, 1:] - self._steps(V), translated(task.measure, n).map(T)(X[:, 1:])
        problem = {"x": variables, "f": 0.5 * casadi.sumsqr(squared), "g": casadi.veccat(defects, measures)}
        self._solver = casadi.nlpsol("solver", "ipopt", problem, options)
        self._shape, zeros = (T, n + m), np.zeros(n * T)
        limits = np.tile([criterion.limit for criterion in task.criteria], T)
        self._bounds = {"lbg": np.append(zeros, limits - np.inf), "ubg": np.append(zeros, limits)}
        for name, sign, share in zip(("lbx", "ubx"), (-np.inf, np.inf), task.input_bounds, strict=True):
            rows = np.tile(np.append(np.full(n, sign), SHARE * share), (T, 1))
            rows[0, :n] = task.start_mean
            self._bounds[name] = np.append(rows, np.full(n, sign))

    def plan(self, states: Array, inputs: Array) -> tuple[Plan, str, int]:
        """The plan found from a guess of states (T+1, n) and inputs (T, m), the status and the iterations."""
        n, guess = states.shape[1], np.append(np.hstack([states[:-1], inputs]), states[-1])
        found = self._solver(x0=guess, **self._bounds)
        v, stats = found["x"].full().ravel(), self._solver.stats()
        rows = v[:-n].reshape(self._shape)
        plan = Plan(np.vstack([rows[:, :n], v[-n:]]), rows[:, n:], float(found["f"]))
        return plan, stats["return_status"], stats["iter_count"]
