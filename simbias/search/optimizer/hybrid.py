"""A global search, then a local one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from simbias.core import Optimizer
from simbias.core.evaluations import Evaluations
from simbias.core.ranges import Deviation, EvaluationCount, Population, Share
from simbias.core.records import Array
from simbias.search.optimizer.cma import FLAT, RESOLUTION, evolve
from simbias.search.optimizer.nlopt import Algorithm, search_nlopt
from simbias.search.optimizer.sobol import search_sobol


@dataclass(kw_only=True, eq=False)
class Hybrid(Optimizer):
    """A global search until a cost is below the target, then CMA-ES from its best point.

    Where not even CMA-ES gets below the target, both begin again, elsewhere if the exploration is random.
    CMA-ES continues from the best candidate, without a first exploration, if this one is below the target or
    a `candidate_deviation` is given.

    Parameters
    ----------
    exploration
        "sobol", or NLopt's name of a global algorithm, as in `Nlopt`.
    explorations
        Evaluations that it makes at most before CMA-ES takes over.
    initial_deviation
        Standard deviation of CMA-ES's first generation, in units of the box's width.
    population
        Points of a generation of CMA-ES; None is pycma's default for the dimension.
    resolution
        CMA-ES gives up when it fails and all its deviations are below it, in units of the box's width.
    candidate_deviation
        Standard deviation of CMA-ES's first generation around the best candidate, even above the target,
        in units of the box's width; None is `initial_deviation`, around one below the target.
    """

    exploration: Literal["sobol"] | Algorithm
    explorations: EvaluationCount
    initial_deviation: Deviation
    population: Population | None
    resolution: Share
    candidate_deviation: Deviation | None = None

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Explore and refine, again and again as long as that fails."""
        deviation = self.candidate_deviation if evaluations.count else None
        while True:
            if deviation is None and not evaluations.below_target:
                start = evaluations.explored(lambda part: self._explore(part, rng), self.explorations)
            else:
                start = evaluations.start
            stopped_by = self._refined(evaluations, rng, start, deviation or self.initial_deviation)
            if stopped_by == FLAT or (evaluations.below_target and stopped_by != RESOLUTION):
                return stopped_by
            deviation = None

    def _explore(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """The global search; why it ended, in words."""
        if self.exploration == "sobol":
            return search_sobol(evaluations, rng)
        return search_nlopt(self.exploration, evaluations, rng)

    def _refined(
        self, evaluations: Evaluations, rng: np.random.Generator, start: Array, deviation: float
    ) -> str:
        """CMA-ES from a point (p,); why it ended. Its resolution is in proportion to its deviation."""
        resolution = self.resolution * deviation / self.initial_deviation
        return evolve(evaluations, rng, start, deviation, self.population, resolution)
