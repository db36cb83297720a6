"""How a component joins the compiled closed loop: instructions and rules for its author.

**In NumPy.** Most authors need to do nothing. A method in ordinary vectorised NumPy, of x (..., n), is called
once on symbols, and its computation is written down as a kernel (`simbias.simulation.compiler.tracing`):

    def step(self, x, u):
        velocity = x[..., 1] + self.time_step * u[..., 0] / self.mass
        return np.stack([x[..., 0] + self.time_step * velocity, velocity], axis=-1)

Supported are arithmetic, elementary functions, indices, sums, matrix products, `np.where` with comparisons,
`np.clip`, `np.stack`, filling arrays from `np.zeros_like` and `x.copy()`, `np.linalg.solve` of small
matrices, `np.interp` of a constant table, `np.rint` and `np.round`. `%`, `//` and `np.floor` give NumPy's
numbers even where a period begins: for `t / p`, and for that times a number or plus a phase. Other uses of
`t / p` may be off by rounding: `(t / p) % 1` is never below 0, but `t / p - np.floor(t / p)` may be. `%` and
`//` take 6 ns each, `np.floor` less than one. Arrays of conditions add up as in NumPy: the sum of two is a
condition, and `np.sum` counts. Supported keywords are `axis`, `keepdims`, `dtype=float`, the named bounds of
`np.clip`, and `out` of elementwise functions; a warning names the first other keyword argument, such as
`where` or `initial`. Not supported are `if` and `while` on values, masks as indices, filling arrays from
`np.zeros`, `np.asarray(x, float)`, random numbers, memory other than the state, other libraries, or more than
MOST operations (`simbias.simulation.compiler.symbols`) or a thousand constants, six for each row of a table.
If code uses these, or the kernel gives other numbers, the loop runs in NumPy, up to 500 times slower, and a
warning names the line.

**By hand.** A kernel is an ordinary Python function of a few numbers and its parameters. It may branch, and
replaces the traced NumPy method:

    def _step(x, u, parameters):
        position, velocity = x
        time_step, mass = parameters
        velocity = velocity + time_step * u[0] / mass
        return position + time_step * velocity, velocity

    self.kernel = Kernel(_step, np.array([time_step, mass]))

Vectors are tuples, and so are parameters. No decorator is needed: functions that it calls are compiled with
it, and again when any of them changes (`simbias.simulation.compiler.compilation`). They have to be imported
by name: it may call `half(x)`, but not `helpers.half(x)`. The loop runs it for LANES rollouts at once, in the
lanes of vector registers. This requires code without branches: arithmetic, `abs`, `min`, `max`, `np.sqrt`,
`np.floor`, and `sincos` of `simbias.simulation.compiler.trigonometry`. Loops over up to about ten components
of a tuple are fine; longer ones must be written out (`sum_of`). Anything else that Numba supports works too,
but for one rollout after the other, several times slower. A division by zero gives inf or nan, and a rollout
with a non-finite state has failed. Such a function also takes arrays instead of numbers if it has neither
`min`, `max` nor branches. The plain method can then be `elementwise(_step, x, u, parameters=...)`.

    Nominal.kernel           (x, u, parameters) -> x_next               parameters: by scenario
                             (x, u, parameters, model_state) -> x_next, model_state
    FittedBias.kernel        (x, u, parameters) -> correction
                             (x (n, LANES), u (m, LANES), data, correction (n, LANES)) -> None

Tasks, policies and costs are always traced. Parts of a policy that depend only on thetas are computed once
for each:

    Task.measure             (x, constants) -> measures
    Policy.act               (parameters, x, t, policy_state, constants) -> u, policy_state
    Cost.terms               (x_next, u, t, constants) -> terms

A bias that handles all lanes at once may use linear algebra; its data is a tuple of arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from simbias.core.records import Array

LANES = 16  # rollouts in lockstep: this many single-precision numbers fill the widest vector registers


def elementwise(function: Callable, *vectors: Array, parameters: Array) -> Array:
    """A function of numbers, for vectors with any leading axes (..., n): all rows at once."""
    if all(vector.ndim == 1 for vector in vectors):  # as in a robot's control loop
        return _of_numbers(function, vectors, parameters)
    with np.errstate(all="ignore"):  # an overflow is not finite, and counts as failed
        columns = function(*map(_columns, vectors), tuple(parameters))
    shape = (*np.broadcast_shapes(*(np.shape(column) for column in columns)), len(columns))
    rows = np.empty_like(vectors[0], np.float64, shape=shape)
    for index, column in enumerate(columns):
        rows[..., index] = column
    return rows


def _of_numbers(function: Callable, vectors: Sequence[Array], parameters: Array) -> Array:
    """A function of numbers, for one vector each.

    Python's own numbers are faster than NumPy's and overflow without a warning, but cannot be divided by
    zero.
    """
    try:
        return np.array(function(*(tuple(vector.tolist()) for vector in vectors), tuple(parameters.tolist())))
    except (ArithmeticError, ValueError):
        with np.errstate(all="ignore"):
            return np.array(function(*map(tuple, vectors), tuple(parameters)))


def _columns(vectors: Array) -> tuple[Array, ...]:
    """The components (...) of vectors (..., n)."""
    return tuple(vectors[..., index] for index in range(vectors.shape[-1]))
