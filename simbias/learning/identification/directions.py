"""Combinations of parameters that experiments do not determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simbias.core.records import Array
from simbias.learning.identification.identified import Identified

OPEN = 0.5  # a direction is not determined if it keeps at least this share of its prior deviation
SHOWN = 0.3  # least weight of a reported parameter


@dataclass(frozen=True, eq=False)
class Direction:
    """A combination of parameters' coordinates that the data do not determine."""

    deviation: float  # of the posterior along it, in standard deviations of the prior
    vector: Array  # (p,) of unit length, in the coordinates
    weights: Mapping[str, float]  # weights of the parameters that matter

    def __str__(self) -> str:
        if len(self.weights) == 1:
            return next(iter(self.weights))
        text = " ".join(f"{weight:+.1f} {name}" for name, weight in self.weights.items())
        return text.removeprefix("+").replace(" +", " + ").replace(" -", " - ")


def undetermined(fitted: Identified) -> list[Direction]:
    """Orthogonal directions along which the posterior keeps half of the prior deviation, widest first.

    Parameters specific to each recording do not count.
    """
    shared = np.array([not parameter.of_recording for parameter in fitted.parameters], bool)
    variances, vectors = np.linalg.eigh(fitted.covariance * np.outer(shared, shared))
    names = [parameter.name for parameter in fitted.parameters]
    return [
        Direction(float(np.sqrt(variance)), vector, _weights(names, vector))
        for variance, vector in zip(variances[::-1], vectors.T[::-1], strict=True)
        if variance > OPEN**2
    ]


def _weights(names: Sequence[str], vector: Array) -> dict[str, float]:
    """The weights that matter, the largest first and positive."""
    vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
    order = np.argsort(-np.abs(vector))
    return {names[i]: float(vector[i]) for i in order if abs(vector[i]) >= SHOWN}
