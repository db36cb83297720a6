"""Linearisation of a model by central differences, and linear-quadratic problems (Riccati)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are

from simbias.core import FittedBias, Nominal, Task
from simbias.core.records import Array

# Step of differences: of states in their units, of inputs relative to their limits. It is coarse, so that
# friction, which is steep near rest, is not mistaken for damping.
STEP = 0.1


def input_scale(task: Task) -> Array:
    """The inputs' limits (m,); one unit if there is none, as for a state."""
    return np.where(np.isfinite(task.input_limit), task.input_limit, 1.0)


def limits_of(task: Task) -> tuple[Array, Array]:
    """Lower and upper limits (m,) of the inputs; ValueError if an input has none."""
    bounds = task.input_bounds
    for each, limits in zip(task.inputs, np.transpose(bounds), strict=True):
        if not np.isfinite(limits).all():
            raise ValueError(f"inputs.{each.name} has no limit, but this policy needs one")
    return bounds


def derivatives(function: Callable[[Array], Array], points: Array, steps: Array) -> Array:
    """Derivatives (..., k, l) of a function (..., k) at points (..., l), by differences with steps (l,)."""
    moved = np.diag(steps)
    ahead, behind = (function(points[..., None, :] + sign * moved) for sign in (1.0, -1.0))
    return np.swapaxes((ahead - behind) / (2 * steps[:, None]), -1, -2)


def advanced(nominal: Nominal, bias: FittedBias, n: int, points: Array) -> Array:
    """States and model state (..., l) of the corrected model, a step after points (..., l+m), inputs last."""
    x, model_state, u = np.split(points, [n, n + nominal.state_size], axis=-1)
    after, kept = nominal.advance(x, u, model_state)
    return np.concatenate([after + bias.correction(x, nominal.acted(u, kept)), kept], axis=-1)


def linearization(nominal: Nominal, x: Array, u: Array, input_limit: Array) -> tuple[Array, Array]:
    """A (..., n, n) and B (..., n, m) of a model's step at states x (..., n) and inputs u (..., m)."""
    n = x.shape[-1]
    steps = STEP * np.concatenate([np.ones(n), input_limit])
    points = np.concatenate([x, u], axis=-1)
    both = derivatives(lambda each: nominal.step(each[..., :n], each[..., n:]), points, steps)
    return both[..., :n], both[..., n:]


def linear_regulator(A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, Array]:
    """K (m, l) of u = -K s, which minimises the sum of s Q s + u R u, and S (l, l) of the minimum s S s.

    LinAlgError or ValueError if there is none.
    """
    S = solve_discrete_are(A, B, Q, R)
    return np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A), S


class LinearQuadratic(NamedTuple):
    """A time-varying problem over T frames, of z = (s, u): l states and m inputs."""

    M: Array  # (T, l, l+m) s_next = M z
    W: Array  # (T, l+m, l+m) curvature of the costs
    w: Array  # (T, l+m) slope of the costs
    V: Array  # (l, l) curvature of the final cost
    v: Array  # (l,) its slope


def regulation(M: Array, Q: Array, R: Array, V: Array) -> LinearQuadratic:
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
