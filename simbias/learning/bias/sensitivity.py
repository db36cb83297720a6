"""First-order sensitivity of window predictions to a bias along them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from simbias.core import Nominal
from simbias.core.records import Array, Indices
from simbias.simulation.open_loop import Windows, model_states

STEP = 1e-5  # of a state, for finite differences
BATCH = 64  # windows differentiated at once, to bound memory


def sensitivities(nominal: Nominal, windows: Windows, features: Callable[[Array], Array]) -> Array:
    """Derivatives (w, J, n, n R) of chunk means with respect to the weights of R features of each state.

    They are taken along the nominal model's predictions; features (k, R) are of inputs (k, n+m).
    """
    starts, model_state = windows.starts, model_states(nominal, windows)
    batches = [slice(first, first + BATCH) for first in range(0, len(starts), BATCH)]
    return np.concatenate(
        [_of(nominal, windows, features, starts[some], model_state[some]) for some in batches]
    )


def _of(
    nominal: Nominal,
    windows: Windows,
    features: Callable[[Array], Array],
    starts: Indices,
    model_state: Array,
) -> Array:
    """Derivatives (w, J, n, n R) for the windows that begin at rows `starts` (w,)."""
    x = windows.states[starts]
    w, n = x.shape
    diagonal = np.arange(n)
    S = total = np.zeros((w, n, n, 0))
    means = []
    for t in range(windows.window):
        u = windows.inputs[starts + t]
        shifted = x[:, None] + STEP * np.eye(n)
        advanced, _ = nominal.advance(
            shifted, np.repeat(u[:, None], n, axis=1), np.repeat(model_state[:, None], n, axis=1)
        )
        x_next, model_state = nominal.advance(x, u, model_state)
        phi = features(np.concatenate([x, nominal.acted(u, model_state)], axis=1))
        A = (advanced - x_next[:, None]).transpose(0, 2, 1) / STEP
        if not t:
            S = total = np.zeros((w, n, n, phi.shape[1]))
        S = (A @ S.reshape(w, n, -1)).reshape(S.shape)
        S[:, diagonal, diagonal] += phi[:, None]
        x, total = x_next, total + S
        if (t + 1) % windows.chunk == 0:
            means.append(total / windows.chunk)
            total = np.zeros_like(S)
    return np.stack(means, axis=1).reshape(w, len(means), n, -1)
