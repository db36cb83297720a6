"""Score the last policy of a trial of a swing-up as RealAIGym's boards of simulations do (versions 2 and 3).

    python sweeps/studies/board/score.py pendubot TRIAL NAME [--seed 0] [--config-dir CONF]

TRIAL is the folder of a trial of `preset=pendubot_board` or `acrobot_board`, or another one of these robots'
swing-ups whose control period is a whole number of their 2 ms. It writes `con_NAME.py`, a controller that
their scripts take, and prints, on their plant without friction,

- performance (version 2);
- robustness (version 2): 722 runs with changed models, noise, slow or late motors, late measurements, and
  pushes, each held against the goal in its last state;
- uptime (version 3): the share of a minute that the tip is up, while a PID takes the robot elsewhere 15
  times, by the seeds of these; there is no torque of the policy's at the passive joint.

Their plant, its integration, the order of what happens in a step, and the scores are written anew here after
github.com/dfki-ric-underactuated-lab/double_pendulum.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from plant import LIMIT, MINUTE, PLANT, RESET, STEP, Reset, resets, step
from rollouts import HEIGHT, Runs, height

import simbias
from simbias.core import Policy, Task
from simbias.core.records import Array, Flags
from simbias.lab.requests.controller import python_module
from simbias.lab.safety import Bounds
from simbias.simulation.compiler import formulas_of

DRIVEN = ("pendubot", "acrobot")  # the first joint, or the second
SECONDS = 10.0
TYPICAL = {"time": 20.0, "energy": 60.0, "torque": 20.0, "smoothness": 0.1, "velocity": 400.0}
NEAR = np.array([0.35, 0.35, 1.0, 1.0])  # of the goal, in the last state
LEVELS, REPETITIONS, PUSHED = 21, 10, 50
DRAWN = 100  # scenarios of each kind, to choose a policy by
SEEDS = range(10)  # of the resets
CHANGED = {  # of the plant, one at a time: from, to; relative where it is of a link
    "rotor": (0.0, 1e-4),
    "b_1": (-0.1, 0.1),
    "b_2": (-0.1, 0.1),
    "c_1": (-0.2, 0.2),
    "c_2": (-0.2, 0.2),
    **dict.fromkeys(("r_1", "I_1", "r_2", "m_2", "I_2"), (0.75, 1.25)),
}
WRAPPER = '''

from double_pendulum.controller.abstract_controller import AbstractController


class Learned(AbstractController):
    """Asks for the torque of the {joint} joint once in {period} s, and holds it in between."""

    def init_(self):
        self._controller, self._until, self._torque = Controller(), 0.0, 0.0

    reset_ = init_

    def get_control_output_(self, x, t=None):
        if t >= self._until - 1e-9:
            self._torque = float(self._controller([x[0] - np.pi, x[1], x[2], x[3]])[0])
            self._until = t + TIME_STEP  # not asked during a reset, it does not make up for it
        return np.array({output})


controller = Learned()
controller.init()
leaderboard_config = {{
    "csv_path": "{name}/sim_swingup.csv",
    "name": "{name}",
    "simple_name": "{name}",
    "short_description": "Network and LQR, searched by simbias among models drawn from what experiments tell",
    "readme_path": "readmes/{name}.md",
    "username": "simbias",
}}
'''


@dataclass(frozen=True)
class Scenario:
    """One run: how it differs from the plant as drawn."""

    kind: str
    level: int = 0
    plant: tuple[tuple[str, float], ...] = ()
    velocity_noise: float = 0.0  # rad/s
    torque_noise: float = 0.0  # N m
    response: float = 1.0
    delay: float = 0.0  # s
    pushes: tuple[tuple[float, float, float], ...] = ()  # s, s, N m: middle, standard deviation, size


UNDISTURBED = Scenario("none")


def scenarios(joint: int, rng: np.random.Generator) -> list[Scenario]:
    """Those of the robustness score."""
    found, levels, repeated = [], range(LEVELS), np.repeat(np.arange(LEVELS), REPETITIONS)
    for name, (low, high) in CHANGED.items():
        scale = PLANT[name] or 1.0
        values = np.linspace(low, high, LEVELS) * scale
        found += [Scenario("model", i, ((name, value),)) for i, value in enumerate(values)]
    share = np.linspace(0.0, 1.0, LEVELS)
    found += [Scenario("velocity noise", i, velocity_noise=0.5 * share[i]) for i in repeated]
    found += [Scenario("torque noise", i, torque_noise=1.1 * share[i]) for i in repeated]
    found += [Scenario("response", i, response=0.1 + 1.9 * share[i]) for i in levels]
    found += [Scenario("delay", i, delay=0.04 * share[i]) for i in levels]
    return found + [Scenario("pushes", i, pushes=_pushes(joint, rng)) for i in range(PUSHED)]


def drawn_scenarios(joint: int, rng: np.random.Generator, count: int = DRAWN) -> list[Scenario]:
    """As many of each kind, drawn from the score's ranges: to choose a policy by, without its score."""
    names, share, found = [*CHANGED], rng.random(count), []
    for i in range(count):
        name = names[i % len(names)]
        value = rng.uniform(*CHANGED[name]) * (PLANT[name] or 1.0)
        found.append(Scenario("model", plant=((name, value),)))
    found += [Scenario("velocity noise", velocity_noise=0.5 * each) for each in share]
    found += [Scenario("torque noise", torque_noise=1.1 * each) for each in share]
    found += [Scenario("response", response=0.1 + 1.9 * each) for each in share]
    found += [Scenario("delay", delay=0.04 * each) for each in share]
    return found + [Scenario("pushes", pushes=_pushes(joint, rng)) for _ in range(count)]


def _pushes(joint: int, rng: np.random.Generator) -> tuple[tuple[float, float, float], ...]:
    """Three at the driven joint, of six whose middles are at least 1 s apart."""
    middles = rng.permutation(np.cumsum(1.0 + 0.5 * rng.random(6))).reshape(2, 3)[joint]
    sizes = rng.uniform(-4.5, 4.5, 3)
    return tuple(zip(middles, rng.uniform(0.05, 0.1, 3), sizes + 0.5 * np.sign(sizes), strict=True))


class Law(Protocol):
    """Torques (lanes,) after measured states (lanes, 4); who is not `asked` keeps the one before."""

    def __call__(self, x: Array, t: float, asked: Flags | bool = True) -> Array: ...


def simulate(law: Law, each: list[Scenario], joint: int, rng: np.random.Generator) -> Runs:
    """Runs from rest, hanging: one lane for each scenario."""
    lanes, steps = len(each), round(SECONDS / STEP)
    plant = {
        name: np.array([dict(one.plant).get(name, value) for one in each]) for name, value in PLANT.items()
    }
    noise, shaken, response = (
        np.array([getattr(one, name) for one in each])
        for name in ("velocity_noise", "torque_noise", "response")
    )
    delays = np.array([int(one.delay / STEP) for one in each])
    pushes, times = np.zeros((steps, lanes)), STEP * np.arange(steps)
    for lane, one in enumerate(each):
        for middle, deviation, size in one.pushes:
            pushes[:, lane] += size * np.exp(-0.5 * ((times - middle) / deviation) ** 2)
    X, U = np.zeros((steps + 1, lanes, 4)), np.zeros((steps, lanes, 2))
    last, lane = np.zeros(lanes), np.arange(lanes)
    for k in range(steps):
        measured = X[np.maximum(k - delays, 0), lane]
        measured[:, 2:] += noise[:, None] * rng.standard_normal((lanes, 2))
        u = last + response * (law(measured, times[k]) - last)
        last = np.clip(u + shaken * rng.standard_normal(lanes), -LIMIT, LIMIT) + pushes[k]
        U[k, :, joint] = last
        X[k + 1] = np.clip(np.nan_to_num(step(X[k], U[k], plant)), -1e4, 1e4)
    return Runs(STEP * np.arange(steps + 1), X, np.concatenate([U, U[-1:]]), np.full(lanes, steps + 1))


def performance(law: Law, joint: int, one: Scenario = UNDISTURBED) -> float:
    """The score, on the plant as drawn unless `one` changes it."""
    run = simulate(law, [one], joint, np.random.default_rng(0))
    commanded = Runs(run.times[:-1], run.states[:-1], run.commands[:-1], run.rows - 1)
    return float(commanded.outcomes(SECONDS, TYPICAL)["score"][0])


def robustness(
    law: Law, joint: int, seed: int, changed: Callable[[Scenario], Scenario] | None = None
) -> dict[str, float]:
    """Rates of success by kind, and their mean, the score; not theirs if scenarios are `changed`."""
    rng = np.random.default_rng(seed)
    each = scenarios(joint, rng)
    each = [changed(one) for one in each] if changed else each
    held, rates = succeeds(simulate(law, each, joint, rng)), dict[str, float]()
    for kind in dict.fromkeys(one.kind for one in each):
        own = np.array([one.kind == kind for one in each])
        if kind.endswith("noise"):  # a level counts if more than half of its runs succeed
            rates[kind] = float(np.mean(held[own].reshape(LEVELS, REPETITIONS).mean(axis=1) > 0.5))
        else:
            rates[kind] = float(np.mean(held[own]))
    return rates | {"robustness": float(np.mean(list(rates.values())))}


def development_score(law: Law, joint: int) -> float:
    """The share of drawn scenarios that the law holds: as robustness, but on scenarios of its own."""
    rng = np.random.default_rng(DRAWN)
    return float(np.mean(succeeds(simulate(law, drawn_scenarios(joint, rng), joint, rng))))


def uptime(law: Law, joint: int, seeds: Sequence[int], after: list[Array] | None = None) -> Array:
    """Shares (lanes,) of a minute that the tip is up, by the seed of the resets.

    States (4,) in which resets leave the robot are appended to `after`.
    """
    drawn = [resets(seed) for seed in seeds]
    angles, begins = np.stack([each[0] for each in drawn]), np.stack([each[1] for each in drawn])
    lanes, steps = len(drawn), round(MINUTE / STEP)
    plant = {name: np.full(lanes, value) for name, value in PLANT.items()}
    x, up, count, pid = np.zeros((lanes, 4)), np.zeros(lanes), np.zeros(lanes, int), Reset(lanes)
    left = np.zeros(lanes, int)  # steps of a reset
    for k in range(steps):
        begin = (left == 0) & (k * STEP >= begins[np.arange(lanes), count])
        count, left = count + begin, np.where(begin, round(RESET / STEP) + 1, left)
        held, aim = left > 0, angles[np.arange(lanes), np.maximum(count, 1) - 1]
        u = np.where(held[:, None], pid.torques(x, aim, held, plant), 0.0)
        own = law(x, k * STEP, ~held)
        u[:, joint] = np.where(held, u[:, joint], own)
        x = step(x, np.clip(u, -LIMIT, LIMIT), plant)
        if after is not None:
            after.extend(x[left == 1])
        left = np.maximum(left - 1, 0)
        up += height(x) > HEIGHT
    return up * STEP / MINUTE


def succeeds(runs: Runs) -> Flags:
    """Which lanes end near the goal."""
    x = runs.states[-1]
    e = np.column_stack([x[:, 0] % (2 * np.pi) - np.pi, (x[:, 1] + np.pi) % (2 * np.pi) - np.pi, x[:, 2:]])
    near: Flags = (np.abs(e) < NEAR).all(axis=1)
    return near


class Asked:
    """A policy of simbias as a law: asked once in a control period, its torque held in between."""

    def __init__(self, policy: Policy, task: Task, theta: Array) -> None:
        self._policy, self._task, self._theta = policy, task, theta
        if abs(round(task.time_step / STEP) * STEP - task.time_step) > 1e-9:
            raise ValueError(
                f"the trial's time step is {task.time_step:g} s; it has to be a multiple of {STEP:g} s"
            )

    def __call__(self, x: Array, t: float, asked: Flags | bool = True) -> Array:
        """Torques (lanes,) after states (lanes, 4), whose first angle is 0 where it hangs."""
        if t == 0.0:
            lanes = len(x)
            self._state = np.zeros((lanes, self._policy.state_size))
            self._torque, self._until = np.zeros(lanes), np.zeros(lanes)
        due = asked & (t >= self._until - 1e-9)
        if due.any():
            shifted = x - np.array([np.pi, 0.0, 0.0, 0.0])
            u, state = self._policy.act(self._theta, shifted, t, self._state)
            self._state = np.where(due[:, None], state, self._state)
            self._torque = np.where(due, u[:, 0], self._torque)
            self._until = np.where(due, t + self._task.time_step, self._until)
        return self._torque


def controller_file(policy: Policy, task: Task, theta: Array, joint: int, name: str) -> str:
    """The text of a controller for their scripts."""
    law = formulas_of(policy, task, theta)
    if isinstance(law, str):
        raise ValueError(f"the policy cannot be written down: {law}")
    infinite = np.full(len(task.states), np.inf)
    bounds = Bounds(task.input_bounds, np.full(len(task.inputs), np.inf), infinite, False)
    joints, output = ("first", "second"), ("[self._torque, 0.0]", "[0.0, self._torque]")
    words = {"joint": joints[joint], "output": output[joint], "period": task.time_step, "name": name}
    return python_module(task, law, f"A swing-up for {name}", bounds) + WRAPPER.format(**words)


def main() -> None:
    """Write the controller, and print its scores."""
    parser = argparse.ArgumentParser(prog="score")
    parser.add_argument("robot", choices=DRIVEN)
    parser.add_argument("trial", type=Path)
    parser.add_argument("name")
    parser.add_argument("--seed", type=int, default=0, help="of noise and pushes")
    parser.add_argument("--config-dir", type=Path, help="of the trial's own components")
    arguments = parser.parse_args()
    trial = simbias.load_trial(arguments.trial, config_dir=arguments.config_dir)
    last = trial.iterations[-1]
    study = trial.study.designed_on(last.model)
    policy, task, theta = study.policy, study.task, last.parameters
    joint = DRIVEN.index(arguments.robot)
    Path(f"con_{arguments.name}.py").write_text(controller_file(policy, task, theta, joint, arguments.name))
    for name, score in scores(Asked(policy, task, theta), joint, arguments.seed).items():
        print(f"{name} {score:.3f}")


def scores(law: Law, joint: int, seed: int) -> dict[str, float]:
    """All scores; `seed` is of the noise and the pushes."""
    shares = uptime(law, joint, SEEDS)
    up = {"uptime": float(shares.mean()), "least": float(shares.min()), "most": float(shares.max())}
    return {"performance": performance(law, joint)} | robustness(law, joint, seed) | up


if __name__ == "__main__":
    main()
