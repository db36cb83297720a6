"""Quasi-random search: the points of a Sobol' sequence."""

from __future__ import annotations

import numpy as np

from simbias.core.evaluations import Evaluations

TOGETHER = 16  # points evaluated at once: a power of two keeps the sequence balanced


def search_sobol(evaluations: Evaluations, rng: np.random.Generator) -> str:
    """Evaluate a scrambled sequence, whose points never wait for each other, until the evaluations end.

    A. B. Owen, "Scrambling Sobol' and Niederreiter-Xing points".
    """
    from scipy.stats import qmc  # takes long to import

    sequence = qmc.Sobol(len(evaluations.lower), scramble=True, rng=rng)
    width = evaluations.upper - evaluations.lower
    while True:
        points = evaluations.lower + width * sequence.random(TOGETHER)
        evaluations.evaluate_all(list(points))
