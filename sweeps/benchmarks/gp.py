"""What one closed-loop step costs with a GP: `python sweeps/benchmarks/gp.py [N ...]` prints a table.

Mean and variance of six outputs from seven inputs, on data of hardware experiments. All ways are timed in
turn within one run, on one thread, in processor time, so that a busy machine changes their ratios little:
medians over ROUNDS rounds.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable

import numpy as np
from numba import njit
from scipy.linalg import cho_solve, cholesky
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel
from threadpoolctl import threadpool_limits

import simbias
from simbias.core import FittedBias, StudyWarning
from simbias.core.records import Array, Transitions
from simbias.learning.covariance import correlation
from simbias.simulation.compiler import LANES
from simbias.simulation.compiler.compilation import Compilation

ROUNDS, STEPS, SLOW_STEPS = 15, 4 * LANES, 8
SIZES = [50, 100, 200, 571, 1000, 2000, 4000]
SCALE = np.array([1, 1, 1, 1, 1, 1, 100])
NOISE = np.exp(-4)
HEADER = "| samples | scikit-learn | NumPy | gp | m | sparse_gp | scikit-learn / gp |"


def recorded(n: int) -> Transitions:
    """Transitions of hardware experiments, with the nominal model's best policy and others near it."""
    study = simbias.load(["tracking=none"])
    theta = next(study.run()).parameters
    rng = np.random.default_rng(0)
    data = study.no_data
    while len(data) < n:
        rollout = study.experiment(theta + 0.3 * rng.standard_normal(len(theta)), rng)
        data |= study.samples.select([rollout], study.nominal).transitions
    return data


def references(data: Transitions, queries: Array) -> dict[str, Callable[[], None]]:
    """Step by step, as a simulation calls a library."""
    points = data.inputs / SCALE
    learner = GaussianProcessRegressor(RBF(np.ones(7)) + WhiteKernel(NOISE), alpha=0, optimizer=None)
    learner.fit(points, data.residuals)
    K = correlation(points, points) + NOISE * np.eye(len(points))
    inverse = cho_solve((cholesky(K, lower=True), True), np.eye(len(points)))
    weights = inverse @ data.residuals

    def with_scikit_learn() -> None:
        for query in queries[:SLOW_STEPS] / SCALE:
            learner.predict(query[None], return_std=True)

    def with_numpy() -> None:
        for query in queries[:SLOW_STEPS] / SCALE:
            k = np.exp(-0.5 * np.sum((points - query) ** 2, axis=1))
            k @ weights, 1 + NOISE - k @ inverse @ k

    return {"scikit-learn": with_scikit_learn, "NumPy": with_numpy}


def kernels(name: str, fitted: FittedBias, queries: Array) -> dict[str, Callable[[], None]]:
    """A fitted bias that corrects the rollouts that run in lockstep."""
    x, u = np.ascontiguousarray(queries[:, :6].T), np.ascontiguousarray(queries[:, 6:].T)
    assert fitted.kernel is not None
    correct = Compilation().compiled(fitted.kernel.function, inline=False)
    data, correction = fitted.kernel.parameters, np.empty((6, LANES))

    @njit
    def repeat(x, u, data, correction, times):
        for _ in range(times):
            correct(x, u, data, correction)

    return {name: lambda: repeat(x, u, data, correction, STEPS // LANES)}


def microseconds(functions: dict[str, Callable[[], None]]) -> dict[str, Array]:
    """Processor time of a step (ROUNDS,) by each way."""
    taken: dict[str, list[float]] = {name: [] for name in functions}
    for function in functions.values():
        function()
    for _ in range(ROUNDS):
        for name, function in functions.items():
            start = time.process_time()
            function()
            taken[name].append(time.process_time() - start)
    steps = {name: SLOW_STEPS if name in ("scikit-learn", "NumPy") else STEPS for name in functions}
    return {name: 1e6 * np.array(values) / steps[name] for name, values in taken.items()}


def main(sizes: list[int]) -> None:
    """Print microseconds a step, for each number of samples."""
    exact, sparse = (simbias.load(["tracking=none", f"bias={option}"]).bias for option in ("gp", "sparse_gp"))
    everything = recorded(max(sizes))
    queries = everything.inputs[np.random.default_rng(1).integers(0, len(everything), LANES)]
    print(f"us a step of {LANES} rollouts in lockstep; m: inducing points of sparse_gp\n")
    print(HEADER)
    print("| --: " * 7 + "|")
    for n in sizes:
        data = Transitions(everything.inputs[:n], everything.residuals[:n])
        thin = sparse.fit(data)
        ways = references(data, queries)
        ways |= kernels("gp", exact.fit(data), queries) | kernels("sparse_gp", thin, queries)
        taken = microseconds(ways)
        cells = [f"{np.median(values):.3g}" for values in taken.values()]
        cells.insert(3, f"{thin.diagnostics['inducing_points']:.0f}")
        ratio = np.median(taken["scikit-learn"] / taken["gp"])
        print(f"| {n} | {' | '.join(cells)} | {ratio:.0f} |", flush=True)


if __name__ == "__main__":
    warnings.simplefilter("ignore", StudyWarning)
    with threadpool_limits(1):
        main([int(argument) for argument in sys.argv[1:]] or SIZES)
