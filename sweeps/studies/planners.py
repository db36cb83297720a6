"""Which plans are better: those of iterative LQR, or those of multiple shooting with IPOPT?

    pip install 'casadi>=3.8,<4'
    python sweeps/studies/planners.py FOLDER [--presets PRESET ...] [--draws 5] [--experiments 5] [--jobs 2]

For each preset that plans, on its nominal model and on draws from the model's prior, both planners solve the
same discrete problem: weights, horizon, start, limits of inputs and states, first guesses. IPOPT also begins
with a straight line to the goal. It takes the model's formulas from the compiler's trace, with exact second
derivatives. MuJoCo's engine has no formulas: its slopes are differences, with sliding joints, as for
iterative LQR, and the curvature is that of the cost alone (Gauss-Newton). Each plan is replayed in
simulation, with its inputs alone and with feedback. `planners.csv` has a row for each plan; of the plans on
the nominal model, the best of each planner is also followed on the preset's hardware. `table.md` sums up. A
process uses one core.
"""

from __future__ import annotations

import argparse
import operator
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import casadi  # for this study alone
import numpy as np
import pandas as pd
from joblib import Parallel, delayed

import simbias
from simbias.core import GoalWeights, Nominal, Task
from simbias.core.records import Array
from simbias.search.optimizer import ilqr
from simbias.search.optimizer.following import STEP, Following, Plan
from simbias.search.optimizer.trajectory_candidates import SEED
from simbias.simulation.compiler.symbolic_arrays import row, symbols_in
from simbias.simulation.compiler.symbols import Trace
from simbias.simulation.compiler.written import needed
from simbias.simulation.goal import goal_along, holding, moves
from simbias.simulation.linearization import derivatives
from simbias.trial.study import Study

PRESETS: Mapping[str, list[str]] = {
    **{f"{name}_trajectory": [] for name in ("cartpole", "acrobot", "pendubot")},
    "pendulum_swingup": ["~policy.units", "policy=trajectory", "method=trajectory"],
    **{"quadrotor_square": [], "arm_eight": []},  # noqa: PIE800
}
ROWS, AGREES = 100, 1e-12  # random states at which formulas are compared, and their relative difference
FEASIBLE = 1e-5  # largest defect of a plan between frames, of states in their units
LOWER = 0.99  # times the other planner's cost: counts as lower
IPOPT = {"print_level": 0, "sb": "yes", "max_iter": 500, "max_wall_time": 60.0, "tol": 1e-6}
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
    v = casadi.SX.sym("v", sum(sizes))
    given = [symbol.index for each in rows for symbol in each[0]]
    values = dict(zip(given, casadi.vertsplit(v), strict=True))
    for symbol in needed(trace, [results], values):
        if symbol.name == "number":
            values[symbol.index] = casadi.SX(symbol.value)
            continue
        operation = OPERATIONS.get(symbol.name) or getattr(casadi, NAMES.get(symbol.name, symbol.name))
        values[symbol.index] = operation(*(values[operand.index] for operand in symbol.operands))
    made = casadi.Function("made", [v], [casadi.vertcat(*(values[symbol.index] for symbol in results))])
    points = np.random.default_rng(SEED).standard_normal((ROWS, sum(sizes)))
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
    n, T, dense = len(task.states), task.horizon, casadi.Sparsity.dense
    both = n + len(task.inputs)

    def step(nominal: Nominal, points: Array) -> Array:
        return nominal.step(points[..., :n], points[..., n:])

    def slopes(points: Array) -> Array:
        steps = STEP * np.concatenate([np.ones(n), task.input_limit])
        return derivatives(partial(step, nominal.without_dry_friction()), points, steps).swapaxes(1, 2)

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
            rows = np.tile(np.append(np.full(n, sign), ilqr.SHARE * share), (T, 1))
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


def line(task: Task, nominal: Nominal) -> tuple[Array, Array]:
    """States (T+1, n) on a straight line to a goal for all states, and inputs (T, m) that hold the start."""
    share = np.linspace(0.0, 1.0, task.horizon + 1)[:, None]
    states = task.start_mean + share * (goal_along(task)[-1] - task.start_mean)
    return states, np.tile(holding(task, nominal, task.start_mean), (task.horizon, 1))


def judged(plan: Plan, shooting: ilqr.Shooting, nominal: Nominal, task: Task) -> dict[str, Any]:
    """A plan's cost, and whether it succeeds when simulated."""

    def succeeds(states: Array) -> bool:
        return bool((task.violated(states[1:]) < 0).all() and task.succeeds(states))

    replayed = [task.start_mean]
    for u in plan.inputs:
        replayed.append(nominal.step(replayed[-1], u))
    followed = shooting.along_knots(plan, task.time_step * np.arange(task.horizon + 1))
    defect = np.abs(plan.states[1:] - nominal.step(plan.states[:-1], plan.inputs)).max()
    return {
        "cost": plan.cost if defect < FEASIBLE else np.inf,
        "defect": defect,
        "planned_success": succeeds(plan.states),
        "replayed_success": succeeds(np.array(replayed)),
        "followed_success": followed is not None and succeeds(followed.states),
        "goal_error": np.abs(task.error(plan.states[-1], task.time_step * task.horizon)).max(),
        "input_share": np.abs(plan.inputs / task.input_limit).max(),
    }


def on_hardware(study: Study, shooting: ilqr.Shooting, plan: Plan, experiments: int) -> int:
    """In how many experiments the preset's hardware follows a plan, with the best of the gains."""
    policies = shooting.following.policies(plan, study.policy, ilqr.GAIN_WEIGHTS)
    tried = [[study.experiment(p, np.random.default_rng(k)) for k in range(experiments)] for p in policies]
    return max(sum(map(study.passes, rollouts)) for rollouts in tried)


def planned(preset: str, draw: int, experiments: int, overrides: Sequence[str] = ()) -> list[dict[str, Any]]:
    """All plans on a preset's nominal model, number 0, or on a draw: a row for each."""
    study = simbias.load(["tracking=none", f"preset={preset}", *PRESETS[preset], *overrides])
    task, weights = study.task, study.cost.goal_weights
    nominal = study.nominal.draw(np.random.default_rng(draw)) if draw else study.nominal
    shooting = ilqr.Shooting(study.model(nominal=nominal), weights, study.policy.sliding)
    nominal = shooting.following.model.nominal  # with sliding joints, if planned so
    began, moving, rows, plans = time.perf_counter(), moves(goal_along(task)), [], []
    ipopt = MultipleShooting(task, nominal, weights or ilqr.default_weights(task))
    setup = time.perf_counter() - began

    def add(planner: str, guess: str, plan: Plan, status: str, iterations: int, setup: float) -> None:
        """Add a plan that has just been made."""
        took = {"setup_seconds": setup, "seconds": time.perf_counter() - began}
        about = {"preset": preset, "model": draw, "planner": planner, "guess": guess, "status": status}
        rows.append(about | {"iterations": iterations} | took | judged(plan, shooting, nominal, task))
        plans.append(plan)

    for k in range(1 if moving else study.method.trajectories):
        guess = "rest" if moving else f"random {k + 1}"
        rngs = [None if moving else np.random.default_rng(SEED).spawn(k + 1)[k] for _ in range(2)]
        began = time.perf_counter()
        with patch.object(ilqr, "ITERATIONS", 0):  # compiles, too
            first = shooting.plan(rngs[0])
        if first is None:
            continue
        compiling, began = time.perf_counter() - began, time.perf_counter()
        with patch.object(Following, "slopes", autospec=True, side_effect=Following.slopes) as slopes:
            plan = shooting.plan(rngs[1])
        add("iLQR", guess, plan, "", slopes.call_count, compiling)
        began = time.perf_counter()
        add("IPOPT", guess, *ipopt.plan(first.states, first.inputs), setup)
    if not moving:
        began = time.perf_counter()
        add("IPOPT", "line", *ipopt.plan(*line(task, nominal)), setup)
    for planner in ("iLQR", "IPOPT") if experiments and not draw else ():
        own = [k for k, each in enumerate(rows) if each["planner"] == planner]
        best = min(own, key=lambda k: rows[k]["cost"])
        rows[best]["hardware"] = on_hardware(study, shooting, plans[best], experiments)
    return rows


def table(plans: pd.DataFrame) -> str:
    """The best plans of each planner, in markdown; seconds and iterations are those of all its guesses."""
    each = plans.sort_values("cost", kind="stable").groupby(["preset", "model", "planner"], sort=False)
    best, spent = each.first().sort_index(), each[["seconds", "iterations"]].sum()
    others = best["cost"].groupby(["preset", "model"]).transform("max")
    best["lower"] = best["cost"] < LOWER * others
    head = "preset | planner | cost, nominal | median cost, draws | lower cost | succeed, inputs alone"
    head += " | with feedback | median seconds | iterations | on hardware"
    lines = [f"| {head} |", "| :-- | :-- |" + " --: |" * 8]
    for key in plans[["preset", "planner"]].drop_duplicates().itertuples(index=False, name=None):
        own, took = (each.xs(key, level=("preset", "planner")) for each in (best, spent))
        seconds, iterations = took.median()
        cells = [*key, f"{own['cost'][0]:.4g}", f"{own['cost'][1:].median():.4g}"]
        cells += [
            f"{own[name].sum()} of {len(own)}" for name in ("lower", "replayed_success", "followed_success")
        ]
        cells += [f"{seconds:.1f}", f"{iterations:.0f}"]
        if "hardware" in own:
            cells.append(f"{own['hardware'][0]:.0f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=list(PRESETS), metavar="PRESET")
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--experiments", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--set", nargs="+", default=[], metavar="OVERRIDE", help="of every preset's config")
    given = parser.parse_args()
    each = [(preset, draw) for preset in given.presets for draw in range(given.draws + 1)]
    made = Parallel(given.jobs)(delayed(planned)(*one, given.experiments, given.set) for one in each)
    plans = pd.DataFrame([plan for rows in made for plan in rows])
    plans.to_csv(given.folder / "planners.csv", index=False, lineterminator="\n", float_format="%.6g")
    (given.folder / "table.md").write_text(table(plans))
    print(table(plans), end="")
