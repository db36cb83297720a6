"""A global search, then a local one."""

from __future__ import annotations

from typing import Literal

import numpy as np

from simbias.core import Optimizer
from simbias.core.evaluations import Evaluations
from simbias.core.ranges import Deviation, EvaluationCount, Population, Seconds, Share, Steps
from simbias.core.records import Array
from simbias.search.optimizer.cma import RESOLUTION, evolve
from simbias.search.optimizer.nlopt import Algorithm, Nlopt
from simbias.search.optimizer.sobol import Sobol


class Hybrid(Optimizer):
    """A global search explores the box until a cost is satisfactory, CMA-ES goes on from its best point.

    Where not even that is satisfactory, both begin again, elsewhere if the exploration is random. CMA-ES goes
    on from the best candidate, without a first exploration, if this one is satisfactory or a
    `candidate_deviation` is given.

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
    max_evaluations
        N_in, of all stages; the search never makes more.
    relative_tolerance
        epsilon: the search ends when CMA-ES improves the best cost Z by less than epsilon |Z|.
    max_steps, max_seconds
        Of simulation and of wall time, after which the search ends too.
    candidate_deviation
        Standard deviation of CMA-ES's first generation around the best of the candidates, whatever it costs,
        in units of the box's width; None is `initial_deviation`, around a satisfactory one.
    """

    def __init__(
        self,
        exploration: Literal["sobol"] | Algorithm,
        explorations: EvaluationCount,
        initial_deviation: Deviation,
        population: Population | None,
        resolution: Share,
        max_evaluations: EvaluationCount,
        relative_tolerance: Share,
        max_steps: Steps | None = None,
        max_seconds: Seconds | None = None,
        candidate_deviation: Deviation | None = None,
    ) -> None:
        self.max_evaluations = max_evaluations
        self.relative_tolerance = relative_tolerance
        self.max_steps, self.max_seconds = max_steps, max_seconds
        self._explorer: Optimizer = (
            Sobol(max_evaluations, relative_tolerance)
            if exploration == "sobol"
            else Nlopt(exploration, max_evaluations, relative_tolerance)
        )
        self._explorations = explorations
        self._initial_deviation = initial_deviation
        self._population = population
        self._resolution = resolution
        self._candidate_deviation = candidate_deviation

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Explore and refine, again and again as long as that fails."""
        own = self._candidate_deviation if evaluations.count else None
        while True:
            if own is None:
                start = evaluations.start if evaluations.satisfied else self._explored(evaluations, rng)
                stopped_by = self._refined(evaluations, rng, start, self._initial_deviation)
            else:
                stopped_by = self._refined(evaluations, rng, evaluations.start, own)
                own = None
            if evaluations.satisfied and stopped_by != RESOLUTION:
                return stopped_by

    def _refined(
        self, evaluations: Evaluations, rng: np.random.Generator, start: Array, deviation: float
    ) -> str:
        """CMA-ES from a point (p,); why it ended. Its resolution is in proportion to its deviation."""
        resolution = self._resolution * deviation / self._initial_deviation
        return evolve(evaluations, rng, start, deviation, self._population, resolution)

    def _explored(self, evaluations: Evaluations, rng: np.random.Generator) -> Array:
        """The best point (p,) of a global search."""
        exploration = evaluations.exploration(self._explorations)
        exploration.run(lambda running: self._explorer.search(running, rng))
        evaluations.adopt(exploration)
        return exploration.start
