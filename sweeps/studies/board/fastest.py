"""How long can the board's pendulum be up? Plan the fastest way up from where resets leave one that stood.

    pip install 'simbias[study]'
    python sweeps/studies/board/fastest.py pendubot OUT.csv [--seeds 10] [--jobs 2]

The robot is known and nothing disturbs it, so no policy is up for good sooner than the fastest plan. Plans
end upright and at rest, and stay up from the time on that is minimised. They are the fastest of those nearby,
found by multiple shooting and IPOPT from several guesses: what is printed is an estimate. OUT.csv has a row
for the start and for each reset, with the tip's height at that time on the plant.
"""

from __future__ import annotations

import argparse
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from plant import LIMIT, MINUTE, PLANT, RESET, RESETS, STEP, Reset, derivatives, resets, step
from rollouts import HEIGHT, LENGTHS, height
from score import DRIVEN

from simbias.core.records import Array

RISING, HOLDING = 40, 30  # intervals of constant torque
STEPS = 4  # of the integration in an interval
LONGEST, FASTEST = 3.0, 60.0  # s, rad/s
GUESSES = (0.3, 0.5, 0.8, 1.2)  # s, of a straight line to the goal
WINDINGS = range(-2, 3)  # turns of each joint to where it is upright and straight
FURTHEST = (1.6 * np.pi, 2.6 * np.pi)  # rad, of each joint on its way
TURN = 2.0 * np.pi


@cache
def _problem(joint: int) -> tuple[Any, ...]:
    """The fastest plan's problem, with its variables, and its parameters: first and last state."""
    import casadi  # for this study alone

    casadi.GlobalOptions.setNumpyMode(1)
    x, u, h = casadi.SX.sym("x", 4), casadi.SX.sym("u"), casadi.SX.sym("h")
    torques = [u, 0.0] if joint == 0 else [0.0, u]

    def rate(x: Any) -> Any:
        return casadi.vertcat(*derivatives(casadi.vertsplit(x), torques, PLANT))

    after = x
    for _ in range(STEPS):
        k_1 = rate(after)
        k_2 = rate(after + h / 2 * k_1)
        k_3 = rate(after + h / 2 * k_2)
        after += h / 6 * (k_1 + 2 * (k_2 + k_3) + rate(after + h * k_3))
    interval = casadi.Function("interval", [x, u, h], [after])

    opti, n = casadi.Opti(), RISING + HOLDING
    X, U, rising, holding = opti.variable(4, n + 1), opti.variable(1, n), opti.variable(), opti.variable()
    first, last = opti.parameter(4), opti.parameter(4)
    lengths = casadi.horzcat(
        casadi.repmat(rising / RISING, 1, RISING), casadi.repmat(holding / HOLDING, 1, HOLDING)
    )
    opti.subject_to(casadi.vec(X[:, 1:] - interval.map(n)(X[:, :-1], U, lengths / STEPS)) == 0)
    opti.subject_to(X[:, 0] == first)
    opti.subject_to(X[:, -1] == last)
    opti.subject_to(opti.bounded(-LIMIT, U, LIMIT))
    opti.subject_to(opti.bounded(-FASTEST, casadi.vec(X[2:, :]), FASTEST))
    opti.subject_to(opti.bounded(1e-3, rising, LONGEST))
    opti.subject_to(opti.bounded(0.05, holding, LONGEST))
    first_angle, both = X[0, RISING:], X[0, RISING:] + X[1, RISING:]
    opti.subject_to(-LENGTHS[0] * casadi.cos(first_angle) - LENGTHS[1] * casadi.cos(both) >= HEIGHT)
    opti.minimize(rising + 1e-3 * holding)
    quiet = (
        {"print_time": False, "expand": True},
        {"print_level": 0, "sb": "yes", "max_iter": 300, "tol": 1e-4},
    )
    opti.solver("ipopt", *quiet)
    return opti, X, U, rising, holding, first, last


def _plan(joint: int, begin: Array, end: Array, guess: float, seed: int) -> tuple[float, float]:
    """Seconds of the plan found from a guess, infinite if none is, and the tip's height then on the plant."""
    opti, X, U, rising, holding, first, last = _problem(joint)
    share = np.minimum(np.arange(RISING + HOLDING + 1) / RISING, 1.0)
    line = begin[:, None] * (1.0 - share) + end[:, None] * share
    line[2:] += (end - begin)[:2, None] / guess * (share < 1.0)
    opti.set_value(first, begin)
    opti.set_value(last, end)
    opti.set_initial(X, line)
    opti.set_initial(U, np.random.default_rng(seed).normal(0.0, 1.0, (1, RISING + HOLDING)))
    opti.set_initial(rising, guess)
    opti.set_initial(holding, 0.5)
    try:
        found = opti.solve()
    except RuntimeError:  # IPOPT found none
        return np.inf, np.nan
    seconds, torques = float(found.value(rising)), np.ravel(found.value(U))
    x, plant = begin[None], {name: np.full(1, value) for name, value in PLANT.items()}
    for k in range(round(seconds / STEP)):
        u = np.zeros((1, 2))
        u[0, joint] = torques[min(int((k + 0.5) * STEP / seconds * RISING), RISING - 1)]
        x = step(x, u, plant)
    return seconds, float(height(x)[0])


def fastest(joint: int, begin: Array) -> tuple[float, float]:
    """Seconds until the tip is up for good, of the fastest plan found, and the tip's height then."""
    upright = np.array([np.pi, 0.0])
    turned = upright + TURN * np.round((begin[:2] - upright) / TURN)
    ends = [turned + TURN * np.array(each) for each in product(WINDINGS, WINDINGS)]
    near = [np.append(end, [0.0, 0.0]) for end in ends if (np.abs(end - begin[:2]) < FURTHEST).all()]
    return min(_plan(joint, begin, end, guess, k) for k, (end, guess) in enumerate(product(near, GUESSES)))


def after_reset(angles: Array) -> tuple[Array, float]:
    """The state (4,) after a reset toward angles (2,) of a robot that stood, and the seconds up in it."""
    x, pid, up = np.array([[np.pi, 0.0, 0.0, 0.0]]), Reset(1), 0
    plant = {name: np.full(1, value) for name, value in PLANT.items()}
    for _ in range(round(RESET / STEP) + 1):
        x = step(x, np.clip(pid.torques(x, angles[None], np.array([True]), plant), -LIMIT, LIMIT), plant)
        up += int(height(x)[0] > HEIGHT)
    return x[0], up * STEP


def row(joint: int, seed: int, index: int, angles: Array) -> dict[str, Any]:
    """A reset, and the fastest plan after it; number 0 is the start."""
    begin, up = after_reset(angles) if index else (np.zeros(4), RESET + STEP)
    seconds, tip = fastest(joint, begin)
    names = ("angle_1", "angle_2", "d_angle_1", "d_angle_2")
    where = dict(zip(names, begin.round(4).tolist(), strict=True))
    down = RESET + STEP - up + seconds
    return {"seed": seed, "reset": index, **where, "seconds": seconds, "down": down, "height": tip}


def main() -> None:
    """Plan from the start and all resets, and print what uptime that allows."""
    parser = argparse.ArgumentParser(prog="fastest", description=__doc__.splitlines()[0])
    parser.add_argument("robot", choices=DRIVEN)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    each = [(0, 0, np.zeros(2))]
    for seed in range(arguments.seeds):
        each += [(seed, k, angles) for k, angles in enumerate(resets(seed)[0], start=1)]
    joint = DRIVEN.index(arguments.robot)
    from fastest import row as own  # processes do not find what a script defines

    table = pd.DataFrame(Parallel(arguments.jobs)(delayed(own)(joint, *one) for one in each))
    table.round(4).to_csv(arguments.out, index=False)
    start, after = table.iloc[0], table.iloc[1:].replace(np.inf, np.nan)
    shares = 1.0 - (start["down"] + RESETS * after.groupby("seed")["down"].mean()) / MINUTE
    seconds, low, high = after["seconds"], shares.min(), shares.max()
    print(f"up for good {seconds.mean():.3f} s after a reset (median {seconds.median():.3f} s)")
    print(f"no plan was found from {seconds.isna().sum()} of {len(after)} resets, which are left out")
    print(f"up for {shares.mean():.3f} ({low:.3f} to {high:.3f}) of a minute at most")


if __name__ == "__main__":
    main()
