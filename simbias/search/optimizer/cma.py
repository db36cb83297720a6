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

PATIENCE, PROGRESS = 30, 0.01  # generations within which the best mean must improve by this share
RESOLUTION = "the resolution"
NO_PROGRESS = "a lack of progress"
FLAT = "costs that no policy changes"
UNUSED = ("matplotlib.pyplot", "scipy.stats")  # modules not needed by the parts of pycma used here


@dataclass(kw_only=True, eq=False)
class Cma(Optimizer):
    """CMA-ES by pycma (N. Hansen, "The CMA Evolution Strategy: A Tutorial", 2016).

    Parameters
    ----------
    initial_deviation
        Standard deviation of the first generation, in units of the box's width.
    population
        Points per generation; None: pycma's default for the dimension.
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

    It searches the unit box, in whose units deviation and resolution are given; pycma's own boundary handling
    keeps it inside. It gives up if no cost of a generation is below the target and all deviations are below
    the resolution. If generations have newly drawn scenarios, their means are evaluated. The run then ends
    once the best mean is below the target and hardly improves, or if a whole generation costs the same, as on
    a model in which nothing moves. Pycma's own cost criteria are off: they are absolute, or relative to costs
    that failures (Eq. 8) inflate.
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
                if means[-1] > (1 - np.copysign(PROGRESS, before)) * before:  # costs may be negative
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
    """Pycma's strategy in the unit box, with the deviation in its units; `ask` and `tell` drive it."""
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
        "signals_filename": "",  # a file from which pycma would take commands in the working folder
    }
    if len(width) == 1:
        options["maxstd"] = np.inf  # pycma's limit on the deviation raises in one dimension (its issue 302)
    if population is not None:
        options["popsize"] = population
    return _pycma().CMAEvolutionStrategy((start - lower) / width, deviation, options)


@cache
def _pycma() -> Any:
    """Import pycma without libraries for plots and statistics, which slow a process's start by a second."""
    hidden = [name for name in UNUSED if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]  # None: as if not installed
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # its warning that it cannot plot
            import cma
    finally:
        for name in hidden:
            del sys.modules[name]
    return cma
