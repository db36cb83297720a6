"""What a step of a simulated rollout costs: `python sweeps/benchmarks/closed_loop.py` prints a table.

Costs of policies that balance, from sampled starts on sampled models, as in a search by `evaluation=robust`:
compiled, and with the same components in NumPy, beside which a learned bias is compiled. Then the same model
by a kernel that was written by hand, by one that was traced from NumPy, and in that NumPy. All ways are timed
in turn within one run, on one thread, in processor time, so that a busy machine changes their ratios little:
the best of ROUNDS rounds.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numba import set_num_threads
from threadpoolctl import threadpool_limits

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
from in_numpy import CartPole, Feedback

import simbias
from simbias.core import FittedBias, Nominal, Simulator, StudyWarning
from simbias.core.records import Array, Disturbance, Transitions
from simbias.learning.bias.none import ZeroBias
from simbias.simulation.closed_loop import join, simulator
from simbias.simulation.compiler import of_nominal, points_of
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.simulation.open_loop import corrections
from simbias.trial.study import Study

ROUNDS, SCENARIOS = 7, 8
BALANCING = np.array([8.12, 4.73, -6.74, -1.02, -5.56])
SCALE = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0, 20.0])


def fitted(option: str, samples: int) -> FittedBias:
    """A bias from smooth, made-up residuals of the hardware's size."""
    rng = np.random.default_rng(1)
    inputs = rng.normal(size=(samples, 7))
    residuals = 1e-6 * np.tanh(inputs @ rng.normal(size=(7, 6)))
    return simbias.load(["tracking=none", f"bias={option}"]).bias.fit(Transitions(inputs * SCALE, residuals))


def way(bias: FittedBias, noisy: bool, plain: bool, policies: int, horizon: int) -> Callable[[], int]:
    """Simulates so many policies in SCENARIOS scenarios each; how many steps that were."""
    study = simbias.load(["tracking=none", "evaluation=domain_randomization", f"task.horizon={horizon}"])
    rng, task = np.random.default_rng(0), study.task
    loops = []
    for _ in range(SCENARIOS):
        model = replace(study.model(bias), nominal=study.nominal.draw(rng))
        noise = Disturbance(0.1 * rng.normal(size=(horizon, 1)), 1e-4 * rng.normal(size=(horizon + 1, 6)))
        disturbance = noise if noisy else None
        in_numpy = PlainSimulator([model], [disturbance], corrections)
        loops.append(in_numpy if plain else simulator(model, disturbance))
    scenarios = np.tile(np.arange(SCENARIOS), policies)
    starts = np.array([task.draw_start(rng) for _ in range(SCENARIOS)])[scenarios]
    thetas = np.tile(BALANCING, (len(scenarios), 1))
    together = join(loops)
    steps = sum(rollout.frames for rollout in together.rollouts(thetas, starts, scenarios))

    def run() -> int:
        together.costs(study.cost, thetas, starts, scenarios)
        return steps

    return run


class DoublePendulum(Nominal):
    """`simbias.robots.double_pendulum.DoublePendulum`: the same equations, of arrays."""

    def __init__(self, parameters: Array, sub_steps: int) -> None:
        self._parameters = parameters
        self._sub_steps = sub_steps

    def step(self, x: Array, u: Array) -> Array:
        h = self._parameters[0]
        for _ in range(self._sub_steps):
            q, v = x[..., :2], x[..., 2:]
            w = self._velocities(v, u, x, h / 2)
            middle = np.concatenate([q + h / 2 * v, w], axis=-1)
            x = np.concatenate([q + h * w, self._velocities(v, u, middle, h)], axis=-1)
        return x

    def _velocities(self, v: Array, u: Array, at: Array, h: float) -> Array:
        _, a_1, a_2, a_3, rotor, gear, g_1, g_2, *friction = self._parameters
        damping, coulomb = np.array(friction[:2]), np.array(friction[2:])
        q_1, q_2, w_1, w_2 = np.moveaxis(at, -1, 0)
        slope = damping + coulomb * 100 / (1 + (100 * v) ** 2)
        rubbing = damping * v + coulomb * np.arctan(100 * v)
        m_11 = a_1 + a_2 + 2 * a_3 * np.cos(q_2) + (gear**2 + 1) * rotor + h / 2 * slope[..., 0]
        m_12 = a_2 + a_3 * np.cos(q_2) - gear * rotor
        m_22 = a_2 + gear**2 * rotor + h / 2 * slope[..., 1]
        turning = a_3 * np.sin(q_2) * np.stack([w_2 * (2 * w_1 + w_2), -(w_1**2)], axis=-1).T
        f = u - rubbing - np.stack([g_1 * np.sin(q_1) + g_2 * np.sin(q_1 + q_2), g_2 * np.sin(q_1 + q_2)], -1)
        f_1, f_2 = np.moveaxis(f, -1, 0) + turning
        det = m_11 * m_22 - m_12**2
        return v + h * np.stack([(m_22 * f_1 - m_12 * f_2) / det, (m_11 * f_2 - m_12 * f_1) / det], axis=-1)


PENDULUM = ["preset=double_pendulum", "identification=none", "hardware.folder=tests/recordings"]
TWINS: dict[str, tuple[list[str], Callable[[Study], Nominal]]] = {
    "cart-pole": (
        ["preset=cartpole"],
        lambda study: CartPole(study.task, study.nominal._constants[1:]),
    ),
    "double pendulum": (
        PENDULUM,
        lambda study: DoublePendulum(study.nominal.kernel.parameters, study.nominal._sub_steps),
    ),
}


def twins(robot: str) -> dict[str, Callable[[], int]]:
    """Simulates the same policies on a robot's model: its kernel, and what somebody writes in NumPy."""
    options, written = TWINS[robot]
    study = simbias.load([*options, "policy=output_feedback", "bias=none", "tracking=none"])
    rng = np.random.default_rng(0)
    thetas = rng.normal(size=(256, study.policy.n_parameters))
    starts = np.array([study.task.draw_start(rng) for _ in thetas])
    model, in_numpy = study.model(), replace(study.model(), nominal=written(study))
    everything = replace(in_numpy, policy=Feedback(study.task))
    loops = {
        f"{robot}, by hand": simulator(model),
        f"{robot}, traced": simulator(in_numpy),
        f"{robot}, traced with its policy": simulator(everything),
        f"{robot}, NumPy": PlainSimulator([everything], [None]),
    }

    def way(loop: Simulator) -> Callable[[], int]:
        steps = sum(rollout.frames for rollout in loop.rollouts(thetas, starts))

        def run() -> int:
            loop.costs(study.cost, thetas, starts)
            return steps

        return run

    return {name: way(loop) for name, loop in loops.items()}


def tracing(robot: str) -> float:
    """Seconds to trace and check a model that is like one traced before."""
    options, written = TWINS[robot]
    study = simbias.load([*options, "tracking=none"])
    points, seconds = partial(points_of, study.task), []
    for _ in range(ROUNDS):
        model = written(study)
        start = time.process_time()
        assert of_nominal(model, points).kernel is not None
        seconds.append(time.process_time() - start)
    return min(seconds)


def main() -> None:
    """Print nanoseconds a step, for each way."""
    none, sparse, exact = ZeroBias(6), fitted("sparse_gp", 200), fitted("gp", 571)
    ways = {
        "no bias": way(none, False, False, 8, 2000),
        "no bias, noise": way(none, True, False, 8, 2000),
        "no bias, NumPy": way(none, False, True, 32, 200),
        "no bias, noise, NumPy": way(none, True, True, 32, 200),
        "sparse_gp, 200 samples": way(sparse, False, False, 8, 200),
        "sparse_gp, 200 samples, NumPy": way(sparse, False, True, 32, 50),
        "gp, 571 samples": way(exact, False, False, 8, 200),
        "gp, 571 samples, NumPy": way(exact, False, True, 32, 20),
    }
    print_table(ways, "no bias")
    for robot in TWINS:
        print_table(twins(robot), f"{robot}, by hand")
        print(f"\nTo trace and check a {robot}: {1e3 * tracing(robot):.2g} ms\n")


def print_table(ways: Mapping[str, Callable[[], int]], reference: str) -> None:
    """Nanoseconds a step, for each way, and as a ratio to one of them."""
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for run in ways.values():
        run()
    for _ in range(ROUNDS):
        for name, run in ways.items():
            start = time.process_time()
            steps = run()
            taken[name].append(1e9 * (time.process_time() - start) / steps)
    print(f"| | ns a step | over {reference} |\n| --- | --: | --: |")
    for name, values in taken.items():
        print(f"| {name} | {min(values):.3g} | {min(values) / min(taken[reference]):.3g} |")


if __name__ == "__main__":
    warnings.simplefilter("ignore", StudyWarning)
    set_num_threads(1)
    with threadpool_limits(1):
        main()
