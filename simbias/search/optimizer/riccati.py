"""Time-varying linear-quadratic problems, solved backwards (Riccati), optionally with limited inputs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from simbias.core.records import Array


class LinearQuadratic(NamedTuple):
    """A linear-quadratic problem over T frames, of z = (s, u): l states and m inputs."""

    M: Array  # (T, l, l+m) s_next = M z
    W: Array  # (T, l+m, l+m) curvature of the costs
    w: Array  # (T, l+m) slope of the costs
    V: Array  # (l, l) curvature of the final cost
    v: Array  # (l,) its slope


def regulator(M: Array, Q: Array, R: Array, V: Array) -> LinearQuadratic:
    """The problem of staying on a trajectory along M: Q (l, l) or (T, l, l), and V (l, l) at its end."""
    W = beside(np.broadcast_to(Q, (len(M), *V.shape)), R)
    return LinearQuadratic(M, W, np.zeros(W.shape[:2]), V, np.zeros(len(V)))


def beside(Q: Array, R: Array) -> Array:
    """Block-diagonal weights (T, l+m, l+m) from those of states, (T, l, l), and inputs, (m, m)."""
    l, m = len(Q[0]), len(R)  # noqa: E741
    W = np.zeros((len(Q), l + m, l + m))
    W[:, :l, :l], W[:, l:, l:] = Q, R
    return W


def solved(
    problem: LinearQuadratic, seen: int, room: tuple[Array, ...] = (), damping: Array | float = 0.0
) -> tuple[Array, Array, Array]:
    """Steps k (T, m) and gains K (T, m, l) of u = k - K s, backwards in time, and the value V (l, l).

    Gains act on the first `seen` states, and are zero where a step ends at a limit; `room` holds the limits,
    (T, m) each. Damping (m, m) makes steps smaller.
    """
    M, W, w, V, v = problem
    T, l, both = M.shape  # noqa: E741
    k, K, N = np.zeros((T, both - l)), np.zeros((T, both - l, l)), np.eye(both, l)  # z = (s, -K s)
    for t in reversed(range(T)):
        H, h = W[t] + M[t].T @ V @ M[t], w[t] + M[t].T @ v
        found = np.linalg.solve(H[l:, l:] + damping, np.column_stack([h[l:], H[l:, :l]]))
        step, gain = -found[:, 0], found[:, 1:]
        if room:
            step = np.minimum(np.maximum(step, room[0][t]), room[1][t])
            gain[step != -found[:, 0]] = 0.0
        gain[:, seen:] = 0.0
        N[l:] = -gain
        v, V = N.T @ (h + H[:, l:] @ step), N.T @ H @ N
        k[t], K[t] = step, gain
    return k, K, V
