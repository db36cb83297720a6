"""Signatures of the compiled functions that components may offer, one for each role.

A kernel is compiled eagerly for its role's signature and cached on disk beside its source:

    @kernel(STEP)
    def double_integrator(x, u, parameters, x_next): ...

Rollouts call kernels through these signatures, as first-class functions. So a rollout is compiled once for
all components, and no cache can go stale when a component changes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import float64, int64, njit, void

VECTOR = float64[::1]
MATRIX = float64[:, ::1]
CUBE = float64[:, :, ::1]

MEASURE = void(VECTOR, VECTOR, VECTOR)  # x (n,), parameters, out: measures (c,)
OUTPUT = void(VECTOR, VECTOR, VECTOR)  # x (n,), parameters, out: z (q,)
CONTROL = void(VECTOR, VECTOR, VECTOR)  # z (q,), parameters, out: u (m,)
STEP = void(VECTOR, VECTOR, VECTOR, VECTOR)  # x (n,), u (m,), parameters, out: x_next (n,)
COST = float64(MATRIX, MATRIX, int64, VECTOR)  # states (k+1, n), inputs (k, m), frames lost, parameters


def correction_signature(data: Any) -> Any:
    """Signature of a bias kernel: x (k, n), u (k, m), data, out: correction (k, n).

    It corrects k steps at once, of rollouts that run in step; data is of the learner's own type. A row's
    result must not depend on the others, or a search would depend on the number of threads.
    """
    return void(MATRIX, MATRIX, data, MATRIX)


def kernel(signature: Any, **options: Any) -> Callable[[Callable], Any]:
    """Compile a function for one signature, division by zero giving inf or nan as in NumPy."""
    return njit(signature, cache=True, error_model="numpy", nogil=True, **options)
