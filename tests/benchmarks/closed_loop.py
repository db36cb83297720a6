"""What a step of a simulated rollout costs: `python tests/benchmarks/closed_loop.py` prints a table.

Costs of policies that balance, from sampled starts on sampled models, as in a search by `evaluation=robust`:
compiled, and with the same components in NumPy, beside which a learned bias is compiled. All ways are timed
in turn within one run, on one thread, in processor time, so that a busy machine changes their ratios little:
the best of ROUNDS rounds.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numba import set_num_threads
from threadpoolctl import threadpool_limits

import simbias
from simbias.bias.none import ZeroBias
from simbias.interfaces import FittedBias, SlowWarning
from simbias.records import Disturbance, Transitions
from simbias.simulation.closed_loop import join, simulator
from simbias.simulation.correction import corrections
from simbias.simulation.plain import PlainSimulator

ROUNDS, WORLDS = 7, 8
BALANCING = np.array([8.12, 4.73, -6.74, -1.02, -5.56])
SCALE = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0, 20.0])


def fitted(option: str, samples: int) -> FittedBias:
    """A bias from smooth, made-up residuals of the hardware's size."""
    rng = np.random.default_rng(1)
    inputs = rng.normal(size=(samples, 7))
    residuals = 1e-6 * np.tanh(inputs @ rng.normal(size=(7, 6)))
    return simbias.load(["tracking=none", f"bias={option}"]).bias.fit(Transitions(inputs * SCALE, residuals))


def way(bias: FittedBias, noisy: bool, plain: bool, policies: int, horizon: int) -> Callable[[], int]:
    """Simulates so many policies in WORLDS worlds each; how many steps that were."""
    study = simbias.load(["tracking=none", "evaluation=robust_models", f"task.horizon={horizon}"])
    rng, task = np.random.default_rng(0), study.task
    loops = []
    for _ in range(WORLDS):
        model = replace(study.model(bias), nominal=study.nominal.draw(rng))
        noise = Disturbance(0.1 * rng.normal(size=(horizon, 1)), 1e-4 * rng.normal(size=(horizon + 1, 6)))
        disturbance = noise if noisy else None
        in_numpy = PlainSimulator([model], [disturbance], corrections)
        loops.append(in_numpy if plain else simulator(model, disturbance))
    worlds = np.tile(np.arange(WORLDS), policies)
    starts = np.array([task.draw_start(rng) for _ in range(WORLDS)])[worlds]
    thetas = np.tile(BALANCING, (len(worlds), 1))
    together = join(loops)
    steps = sum(rollout.frames for rollout in together.rollouts(thetas, starts, worlds))

    def run() -> int:
        together.costs(study.cost, thetas, starts, worlds)
        return steps

    return run


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
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for run in ways.values():
        run()
    for _ in range(ROUNDS):
        for name, run in ways.items():
            start = time.thread_time()
            steps = run()
            taken[name].append(1e9 * (time.thread_time() - start) / steps)
    print("| | ns a step | over no bias |\n| --- | --: | --: |")
    for name, values in taken.items():
        print(f"| {name} | {min(values):.3g} | {min(values) / min(taken['no bias']):.3g} |")


if __name__ == "__main__":
    warnings.simplefilter("ignore", SlowWarning)
    set_num_threads(1)
    with threadpool_limits(1):
        main()
