"""Quasi-random search: the points of a Sobol' sequence."""

from __future__ import annotations

import numpy as np

from simbias.core import Optimizer
from simbias.core.evaluations import Evaluations

TOGETHER = 16  # points evaluated at once: a power of two keeps the sequence balanced


class Sobol(Optimizer):
    """Evaluates a scrambled Sobol' sequence (A. B. Owen, "Scrambling Sobol' and Niederreiter-Xing points").

    A baseline: what a search gains by learning from its costs. As a first stage, its points never wait for
    each other.
    """

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Evaluate one point after the other, wherever the best one is."""
        return search_sobol(evaluations, rng)


def search_sobol(evaluations: Evaluations, rng: np.random.Generator) -> str:
    """Evaluate the points of a scrambled sequence until the evaluations end."""
    from scipy.stats import qmc  # takes long to import

    sequence = qmc.Sobol(len(evaluations.lower), scramble=True, rng=rng)
    width = evaluations.upper - evaluations.lower
    while True:
        points = evaluations.lower + width * sequence.random(TOGETHER)
        evaluations.evaluate_all(list(points))
