"""Quasi-random search: the points of a Sobol' sequence."""

from __future__ import annotations

import numpy as np

from simbias.core import Optimizer
from simbias.core.evaluations import Evaluations
from simbias.core.ranges import EvaluationCount, Seconds, Share, Steps

TOGETHER = 16  # points evaluated at once: a power of two keeps the sequence balanced


class Sobol(Optimizer):
    """Evaluates a scrambled Sobol' sequence (A. B. Owen, "Scrambling Sobol' and Niederreiter-Xing points").

    A baseline: what a search gains by learning from its costs. As a first stage, its points never wait for
    each other.

    Parameters
    ----------
    max_evaluations
        N_in; the search never makes more.
    relative_tolerance
        epsilon: the search ends when the best cost Z improves by less than epsilon |Z|.
    max_steps, max_seconds
        Of simulation and of wall time, after which the search ends too.
    """

    def __init__(
        self,
        max_evaluations: EvaluationCount,
        relative_tolerance: Share,
        max_steps: Steps | None = None,
        max_seconds: Seconds | None = None,
    ) -> None:
        self.max_evaluations = max_evaluations
        self.relative_tolerance = relative_tolerance
        self.max_steps, self.max_seconds = max_steps, max_seconds

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Evaluate one point after the other, wherever the best one is."""
        from scipy.stats import qmc  # takes long to import

        sequence = qmc.Sobol(len(evaluations.lower), scramble=True, rng=rng)
        width = evaluations.upper - evaluations.lower
        while True:
            points = evaluations.lower + width * sequence.random(TOGETHER)
            evaluations.evaluate_all(list(points))
