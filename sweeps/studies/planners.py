"""Which plans are better: those of iterative LQR, or those of multiple shooting with IPOPT?

    pip install 'simbias[mujoco,study]'
    python sweeps/studies/planners.py FOLDER [--presets PRESET ...] [--draws 5] [--experiments 5] [--jobs 2]

For each preset that plans, on its nominal model and on draws from the model's prior, both planners solve the
same discrete problem: weights, horizon, start, limits of inputs and states, first guesses. IPOPT also begins
with a straight line to the goal. Plans are replayed in simulation, by their inputs alone and with feedback,
and the best plan of each planner on the nominal model also on the preset's hardware. `planners.csv` has a row
for each plan, with seconds of processor time; `table.md` has the best plan of each planner, and medians of
the seconds and iterations that all its guesses took.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from multiple_shooting import MultipleShooting

import simbias
from simbias.core import Nominal, Task
from simbias.core.markdown import table
from simbias.core.records import Array
from simbias.search.optimizer import ilqr
from simbias.search.optimizer.following import Following, Plan
from simbias.search.optimizer.trajectory_candidates import SEED
from simbias.simulation.goal import goal_along, holding, moves
from simbias.trial.study import Study

PRESETS: Mapping[str, list[str]] = {
    **{f"{name}_trajectory": [] for name in ("cartpole", "acrobot", "pendubot")},
    "pendulum_swingup": ["~policy.units", "policy=trajectory", "method=trajectory"],
    **{name: [] for name in ("quadrotor_square", "arm_eight")},
}
FEASIBLE = 1e-5  # largest defect of a plan between frames, of states in their units
LOWER = 0.99  # times the cost of our plan: counts as lower
OURS = {"iLQR": False, "patient iLQR": True}  # whether it is patient
COLUMNS = ["preset", "model", "planner", "guess", "status", "iterations", "setup_seconds", "seconds"]
HEAD = "preset, planner, cost, cost on draws, lower cost, inputs alone succeed, with feedback, seconds, "
HEAD += "iterations, on hardware"


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
        "planned": succeeds(plan.states),
        "replayed": succeeds(np.array(replayed)),
        "followed": followed is not None and succeeds(followed.states),
        "goal_error": np.abs(task.error(plan.states[-1], task.time_step * task.horizon)).max(),
        "input_share": np.abs(plan.inputs / task.input_limit).max(),
    }


def on_hardware(study: Study, shooting: ilqr.Shooting, plan: Plan, experiments: int) -> int:
    """In how many experiments the preset's hardware follows a plan, with the best of the gains."""
    policies = shooting.following.policies(plan, study.policy, ilqr.GAIN_WEIGHTS)
    tried = [[study.experiment(p, np.random.default_rng(k)) for k in range(experiments)] for p in policies]
    return max(sum(map(study.passes, rollouts)) for rollouts in tried)


def timed(function: Callable, *arguments: Any) -> tuple[Any, float]:
    """A function's result, and the processor time that it took."""
    began = time.process_time()
    return function(*arguments), time.process_time() - began


def planned(preset: str, draw: int, experiments: int, overrides: Sequence[str] = ()) -> list[dict[str, Any]]:
    """All plans on a preset's nominal model, number 0, or on a draw: a row for each."""
    study = simbias.load(["tracking=none", f"preset={preset}", *PRESETS[preset], *overrides])
    task, weights = study.task, study.cost.goal_weights
    nominal = study.nominal.draw(np.random.default_rng(draw)) if draw else study.nominal
    model, sliding = study.model(nominal=nominal), study.policy.sliding
    ours = {planner: ilqr.Shooting(model, weights, sliding, patient) for planner, patient in OURS.items()}
    shooting = ours["iLQR"]
    nominal = shooting.following.model.nominal  # with sliding joints, if planned so
    ipopt, setup = timed(MultipleShooting, task, nominal, weights or ilqr.default_weights(task))
    moving, guesses, found = moves(goal_along(task)), dict[str, tuple[Array, Array]](), []
    for k in range(1 if moving else study.method.trajectories):
        guess = "rest" if moving else f"random {k + 1}"
        begun = None if moving else np.random.default_rng(SEED).spawn(k + 1)[k]
        with patch.multiple(ilqr, ITERATIONS=0, PATIENT_ITERATIONS=0):
            (first, compiling), _ = (timed(own.plan, deepcopy(begun)) for own in ours.values())
        if first is None:
            continue
        guesses[guess] = first.states, first.inputs
        for planner, own in ours.items():
            rng, counted = deepcopy(begun), {"autospec": True, "side_effect": Following.slopes}
            with patch.object(Following, "slopes", **counted) as slopes:
                plan, seconds = timed(own.plan, rng)
            found.append((plan, planner, guess, "", slopes.call_count, compiling, seconds))
    if not moving:
        guesses["line"] = line(task, nominal)
    for guess, begin in guesses.items():
        (plan, *outcome), seconds = timed(ipopt.plan, *begin)
        found.append((plan, "IPOPT", guess, *outcome, setup, seconds))
    plans, rows = [plan for plan, *_ in found], []
    for plan, *made in found:
        about = dict(zip(COLUMNS, (preset, draw, *made), strict=True))
        rows.append(about | judged(plan, shooting, nominal, task) | {"hardware": np.nan})
    for planner in (*OURS, "IPOPT") if experiments and not draw else ():
        own = [k for k, each in enumerate(rows) if each["planner"] == planner]
        best = min(own, key=lambda k: rows[k]["cost"])
        rows[best]["hardware"] = on_hardware(study, shooting, plans[best], experiments)
    return rows


def summary(plans: pd.DataFrame) -> str:
    """The best plans of each planner, in markdown."""
    each = plans.sort_values("cost", kind="stable").groupby(["preset", "planner", "model"])
    best = each.first().assign(**each[["seconds", "iterations"]].sum())
    body = []
    for key in plans[["preset", "planner"]].drop_duplicates().itertuples(index=False, name=None):
        own = best.loc[key]
        own = own.assign(lower=own["cost"] < LOWER * best.loc[key[0], "iLQR"]["cost"])
        costs = own["cost"][0], own["cost"][1:].median()
        counts = (f"{own[name].sum()} of {len(own)}" for name in ("lower", "replayed", "followed"))
        last = own["seconds"].median(), own["iterations"].median(), own["hardware"][0]
        body.append([*key, *map("{:.4g}".format, costs), *counts, *map("{:.3g}".format, last)])
    return table(HEAD.split(", "), body)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=list(PRESETS), metavar="PRESET")
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--experiments", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--set", nargs="+", default=[], metavar="OVERRIDE", help="of every preset's config")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    each = [(preset, draw) for preset in given.presets for draw in range(given.draws + 1)]
    made = Parallel(given.jobs)(delayed(planned)(*one, given.experiments, given.set) for one in each)
    plans = pd.DataFrame([plan for rows in made for plan in rows])
    plans.to_csv(given.folder / "planners.csv", index=False, lineterminator="\n", float_format="%.6g")
    (given.folder / "table.md").write_text(summary(plans))
    print(summary(plans), end="")
