"""Quasi-random search: the points of a Sobol' sequence."""

from __future__ import annotations

import numpy as np

from simbias.core.errors import ConfigError
from simbias.core.evaluations import Evaluations

TOGETHER = 16  # points evaluated at once: a power of two keeps the sequence balanced


def search_sobol(evaluations: Evaluations, rng: np.random.Generator) -> str:
    """Evaluate a scrambled sequence, whose points never wait for each other, until the evaluations end.

    A. B. Owen, "Scrambling Sobol' and Niederreiter-Xing points".

    Raises
    ------
    ConfigError
        If no sequence has so many dimensions.
    """
    from scipy.stats import qmc  # takes long to import

    p, most = len(evaluations.lower), qmc.Sobol.MAXDIM
    if p > most:
        raise ConfigError("optimizer.exploration", f"sobol takes {most} parameters at most, not {p}")
    sequence = qmc.Sobol(p, scramble=True, rng=rng)
    width = evaluations.upper - evaluations.lower
    while True:
        points = evaluations.lower + width * sequence.random(TOGETHER)
        evaluations.evaluate_all(list(points))
