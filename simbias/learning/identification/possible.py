"""The physically possible parameters nearest to impossible identified ones."""

from __future__ import annotations

import numpy as np

from simbias.core import Nominal
from simbias.core.parameters import values_at
from simbias.core.records import Array

MARGIN = 0.01  # remaining slack
STEP = 1e-4  # of finite differences
ROUNDS = 20  # of Newton's method; one suffices if constraints are linear in the coordinates
TURNS = 10  # rounds after which constraints that break each other in turn are met together


def nearest_possible(nominal: Nominal, z: Array, spread: Array) -> Array:
    """The coordinates (P,) nearest to z, in the metric of the posterior covariance, that break no constraint.

    Those of the model's p parameters come first; `spread` (P, q) is a square root of the covariance.
    """
    p, covariance = len(nominal.parameters), spread @ spread.T

    def slack(at: Array) -> Array:
        return nominal.with_parameters(values_at(nominal.parameters, at[:p])).slack - MARGIN

    in_turns = np.zeros(len(slack(z)), bool)
    for count in range(ROUNDS):
        short = slack(z)
        if not (short < -MARGIN / 2).any():
            break
        in_turns |= (short < -MARGIN / 2) & (count >= TURNS)
        broken = np.flatnonzero((short < -MARGIN / 2) | in_turns)
        shifted = np.array([slack(z + STEP * e)[broken] for e in np.eye(len(z))[:p]])  # (p, k)
        slopes = np.zeros((len(broken), len(z)))
        slopes[:, :p] = (shifted - short[broken]).T / STEP
        towards = covariance @ slopes.T
        z = z - towards @ np.linalg.pinv(slopes @ towards) @ short[broken]  # certain directions stay
    return z
