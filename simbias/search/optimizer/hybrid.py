"""A global search, then a local one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from simbias.core import Optimizer
from simbias.core.errors import ConfigError
from simbias.core.evaluations import Evaluations
from simbias.core.ranges import Deviation, EvaluationCount, Population, Share
from simbias.search.optimizer.cma import FLAT, RESOLUTION, evolve
from simbias.search.optimizer.nlopt import Algorithm, search_nlopt

TOGETHER = 16  # points of a sequence evaluated at once: a power of two keeps it balanced


@dataclass(kw_only=True, eq=False)
class Hybrid(Optimizer):
    """A global search until a cost is below the target, then CMA-ES from its best point.

    If CMA-ES does not get below the target either, both start again, elsewhere if the exploration is random.
    CMA-ES starts from the best candidate, without a first exploration, if that is below the target or a
    `candidate_deviation` is given.

    Parameters
    ----------
    exploration
        "sobol", or NLopt's name for a global algorithm, as in `Nlopt`.
    explorations
        Maximum number of its evaluations before CMA-ES takes over.
    initial_deviation
        Standard deviation of CMA-ES's first generation, in units of the box's width.
    population
        Points per generation of CMA-ES; None: pycma's default for the dimension.
    resolution
        In units of the box's width: CMA-ES gives up if it fails and all its deviations are below this.
    candidate_deviation
        Standard deviation of CMA-ES's first generation around the best candidate, even above the target,
        in units of the box's width; None: `initial_deviation`, and only around a candidate below the target.
    """

    exploration: Literal["sobol"] | Algorithm
    explorations: EvaluationCount
    initial_deviation: Deviation
    population: Population | None
    resolution: Share
    candidate_deviation: Deviation | None = None

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Explore and refine, repeatedly until it succeeds."""
        explore = search_sobol if self.exploration == "sobol" else partial(search_nlopt, self.exploration)
        deviation = self.candidate_deviation if evaluations.count else None
        while True:
            if deviation is None and not evaluations.below_target:
                start = evaluations.explored(lambda part: explore(part, rng), self.explorations)
            else:
                start = evaluations.start
            deviation = deviation or self.initial_deviation
            resolution = self.resolution * deviation / self.initial_deviation
            stopped_by = evolve(evaluations, rng, start, deviation, self.population, resolution)
            if stopped_by == FLAT or (evaluations.below_target and stopped_by != RESOLUTION):
                return stopped_by
            deviation = None


def search_sobol(evaluations: Evaluations, rng: np.random.Generator) -> str:
    """Evaluate a scrambled Sobol sequence in lockstep until the evaluations end.

    A. B. Owen, "Scrambling Sobol' and Niederreiter-Xing points". ConfigError if there are too many dimensions
    for it.
    """
    from scipy.stats import qmc  # slow to import

    p, most = len(evaluations.lower), qmc.Sobol.MAXDIM
    if p > most:
        raise ConfigError("optimizer.exploration", f"sobol takes at most {most} parameters, got {p}")
    sequence = qmc.Sobol(p, scramble=True, rng=rng)
    width = evaluations.upper - evaluations.lower
    while True:
        points = evaluations.lower + width * sequence.random(TOGETHER)
        evaluations.evaluate_all(list(points))
