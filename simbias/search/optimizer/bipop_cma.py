"""CMA-ES with restarts of two kinds."""

from __future__ import annotations

import numpy as np

from simbias.core import Optimizer
from simbias.core.evaluations import Evaluations
from simbias.core.ranges import Deviation, EvaluationCount, Population, Seconds, Share, Steps
from simbias.search.optimizer.cma import RESOLUTION, evolve


class BipopCma(Optimizer):
    """BIPOP-CMA-ES (N. Hansen, "Benchmarking a BI-Population CMA-ES on the BBOB-2009 Function Testbed").

    As long as the best cost is not satisfactory, runs of CMA-ES follow each other: large ones, whose
    populations double, and, whenever these have made more evaluations, small ones with small deviations.
    The first starts at the best point so far, the others anywhere in the box.

    Parameters
    ----------
    initial_deviation
        Standard deviation of a large run's first generation, in units of the box's width.
    population
        Points of a generation of the first run.
    resolution
        A run that fails gives up when all its deviations are below it, in units of the box's width.
    max_evaluations
        N_in; the search never makes more.
    relative_tolerance
        epsilon: the search ends when the best cost Z improves by less than epsilon |Z|.
    max_steps, max_seconds
        Of simulation and of wall time, after which the search ends too.
    """

    def __init__(
        self,
        initial_deviation: Deviation,
        population: Population,
        resolution: Share,
        max_evaluations: EvaluationCount,
        relative_tolerance: Share,
        max_steps: Steps | None = None,
        max_seconds: Seconds | None = None,
    ) -> None:
        self.max_evaluations = max_evaluations
        self.relative_tolerance = relative_tolerance
        self.max_steps, self.max_seconds = max_steps, max_seconds
        self._initial_deviation = initial_deviation
        self._population = population
        self._resolution = resolution

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Search from the best point so far, then from others."""
        start, deviation, population = evaluations.start, self._initial_deviation, self._population
        generations, largest = np.inf, population
        spent = {"small": 0, "large": 0}  # evaluations
        kind = "small"  # as pycma counts the first run
        while True:
            begun = evaluations.count
            stopped_by = evolve(evaluations, rng, start, deviation, population, self._resolution, generations)
            if evaluations.satisfied and stopped_by != RESOLUTION:
                return stopped_by
            spent[kind] += evaluations.count - begun
            elsewhere = rng.uniform(evaluations.lower, evaluations.upper)
            start = evaluations.start if evaluations.satisfied else elsewhere
            if spent["small"] < spent["large"]:
                kind = "small"
                deviation = self._initial_deviation * 10 ** -rng.uniform(0, 2)
                population = int(self._population * (0.5 * largest / self._population) ** rng.uniform() ** 2)
                generations = max(1, spent["large"] // (2 * population))
            else:
                kind = "large"
                largest *= 2
                deviation, population, generations = self._initial_deviation, largest, np.inf
