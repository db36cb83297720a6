"""Covariance matrix adaptation evolution strategy."""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from simbias.core import Optimizer
from simbias.core.evaluations import Evaluations
from simbias.core.ranges import Deviation, Population
from simbias.core.records import Array

PATIENCE, PROGRESS = 30, 0.01  # generations within which the best of their means has to improve by this share
RESOLUTION = "the resolution"
NO_PROGRESS = "a lack of progress"
FLAT = "costs that no policy changes"
UNUSED = ("matplotlib.pyplot", "scipy.stats")  # by the parts of pycma that are used here


@dataclass(kw_only=True, eq=False)
class Cma(Optimizer):
    """CMA-ES by pycma (N. Hansen, "The CMA Evolution Strategy: A Tutorial", 2016).

    Parameters
    ----------
    initial_deviation
        Standard deviation of the first generation, in units of the box's width.
    population
        Points of a generation; None is pycma's default for the dimension.
    """

    initial_deviation: Deviation
    population: Population | None

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Search from the best point so far, or from the box's centre."""
        return evolve(evaluations, rng, evaluations.start, self.initial_deviation, self.population)


def evolve(
    evaluations: Evaluations,
    rng: np.random.Generator,
    start: Array,
    deviation: float,
    population: int | None = None,
    resolution: float = 0.0,
) -> str:
    """One run of CMA-ES with the mean `start` (p,); why it ended, in words.

    It searches in the unit box, in whose units deviation and resolution are; pycma's own boundary handling
    keeps it inside. It gives up where no cost of a generation is below the target and all deviations are
    below the resolution. Where generations meet scenarios of their own, their means are what is judged, and
    it ends once the best of these, below the target, hardly improves, or where a whole generation costs the
    same, as on a model in which nothing moves. Pycma's own tests on costs are off:
    they are absolute, or relative to what the cost of a failure in Eq. 8 inflates.
    """
    means: list[float] = []  # best costs of means so far
    width = evaluations.upper - evaluations.lower
    evolution = strategy(evaluations.lower, evaluations.upper, rng, start, deviation, population)
    while not (stop := evolution.stop()):
        points = evolution.ask()
        costs = evaluations.rank([evaluations.lower + width * point for point in points])
        evolution.tell(points, costs)
        if evaluations.ranks_afresh:
            if max(costs) == min(costs):
                return FLAT
            costs = [evaluations.evaluate(evaluations.lower + width * evolution.result.xfavorite)]
            means.append(evaluations.best_cost)
            if len(means) > PATIENCE and evaluations.below_target:
                before = means[-1 - PATIENCE]
                if means[-1] > (1 - np.copysign(PROGRESS, before)) * before:  # it may be below zero
                    return NO_PROGRESS
        if max(evolution.stds) < resolution and min(costs) >= evaluations.target_cost:
            return RESOLUTION
    return f"pycma's {' and '.join(stop)}"


def strategy(
    lower: Array,
    upper: Array,
    rng: np.random.Generator,
    start: Array,
    deviation: float,
    population: int | None = None,
) -> Any:
    """Pycma's strategy in the unit box, in whose units the deviation is; `ask` and `tell` drive it."""
    width = upper - lower
    options = {
        "bounds": [0.0, 1.0],
        "randn": lambda *shape: rng.standard_normal(shape),  # leaves NumPy's global generator alone
        "seed": np.nan,  # of NumPy's global generator: not touched
        "maxiter": np.inf,
        "tolfun": 0.0,
        "tolfunhist": 0.0,
        "verbose": -9,
        "verb_log": 0,
        "signals_filename": "",  # a file by which pycma would take commands from the working folder
    }
    if len(width) == 1:
        options["maxstd"] = np.inf  # pycma's limit on it raises in one dimension (its issue 302)
    if population is not None:
        options["popsize"] = population
    return _pycma().CMAEvolutionStrategy((start - lower) / width, deviation, options)


@cache
def _pycma() -> Any:
    """Pycma without the libraries by which it draws and ranks: they take a second of a process's start."""
    hidden = [name for name in UNUSED if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]  # None: as if it were not installed
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it cannot draw
            import cma
    finally:
        for name in hidden:
            del sys.modules[name]
    return cma
