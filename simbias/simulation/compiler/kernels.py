"""How a component joins the compiled closed loop: what its author writes, and what the rules are.

**In NumPy.** Most need to do nothing for it. A method in ordinary vectorised NumPy, of x (..., n), is called
once on symbols, and a kernel is written of what it computes (`simbias.simulation.compiler.tracing`):

    def step(self, x, u):
        velocity = x[..., 1] + self.time_step * u[..., 0] / self.mass
        return np.stack([x[..., 0] + self.time_step * velocity, velocity], axis=-1)

That takes arithmetic, elementary functions, indices, sums, products of matrices, `np.where` and comparisons
in it, `np.clip`, `np.stack`, arrays of `np.zeros_like` and `x.copy()` that are filled, `np.linalg.solve` of
small matrices, `np.interp` of a constant table, `np.rint` and `np.round`. `%`, `//` and `np.floor` give
NumPy's numbers also where a period begins: of `t / p`, and of that times a number or plus a phase. Other uses
of `t / p` may be a rounding off: `(t / p) % 1` is never below 0, `t / p - np.floor(t / p)` may be. `%` and
`//` take 6 ns each, `np.floor` less than one. Arrays of conditions add up as NumPy's do: the sum of two is a
condition, and `np.sum` counts. It takes `axis`, `keepdims`, `dtype=float`, the bounds of `np.clip` by their
names, and `out` of elementwise functions; of other keyword arguments, as `where` and `initial`, a warning
names the first. It does not take `if` and `while` that ask for values, masks as indices, arrays of `np.zeros`
that are filled, `np.asarray(x, float)`, random numbers, what is remembered elsewhere than in its state, other
libraries, or more than MOST operations (`simbias.simulation.compiler.symbols`). Where code does such things,
or what is written gives other numbers, the loop runs in NumPy, up to 500 times slower, and a warning names
the line.

**By hand.** A kernel is an ordinary Python function of a few numbers, and the parameters that it reads. It
may branch, and is used in place of what NumPy would be traced to:

    def _step(x, u, parameters):
        position, velocity = x
        time_step, mass = parameters
        velocity = velocity + time_step * u[0] / mass
        return position + time_step * velocity, velocity

    self.kernel = Kernel(_step, np.array([time_step, mass]))

Vectors come and go as tuples, parameters too. There is nothing to decorate: functions that it calls are
compiled with it, and again when any of them changes (`simbias.simulation.compiler.compilation`). They have to
be imported by name: it may call `half(x)`, not `helpers.half(x)`. The loop runs it for LANES rollouts at
once, in the lanes of vector registers. That takes code without branches: arithmetic, `abs`, `min`, `max`,
`np.sqrt`, `np.floor`, and `sincos` of `simbias.simulation.compiler.trigonometry`. Loops over the components
of a tuple are fine up to about ten; longer ones are to be written out (`sum_of`). What else Numba understands
works too, for one rollout after the other, several times slower. A division by zero gives inf or nan, and a
rollout whose state is not finite has failed. Such a function also takes arrays in place of numbers, as long
as it has neither `min`, `max` nor branches: so the plain method can be `elementwise(_step, x, u,
parameters=...)`.

    Nominal.kernel           (x, u, parameters) -> x_next               parameters: by scenario
                             (x, u, parameters, model_state) -> x_next, model_state
    FittedBias.kernel        (x, u, parameters) -> correction
                             (x (n, LANES), u (m, LANES), data, correction (n, LANES)) -> None

Tasks, policies and costs are always traced. What a policy computes of thetas alone is computed once for each:

    Task.measure             (x, constants) -> measures
    Policy.act               (parameters, x, t, policy_state, constants) -> u, policy_state
    Cost.terms               (x_next, u, t, constants) -> terms

What the bias does for all lanes at once may need linear algebra; its data is a tuple of arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from simbias.core.records import Array

LANES = 16  # rollouts that run in lockstep: as many single-precision numbers fill the widest vector registers


def elementwise(function: Callable, *vectors: Array, parameters: Array) -> Array:
    """A function of numbers, for vectors with any leading axes (..., n): all rows at once."""
    if all(vector.ndim == 1 for vector in vectors):  # as a robot's control loop asks
        return _of_numbers(function, vectors, parameters)
    with np.errstate(all="ignore"):  # what overflows is not finite, and has failed
        columns = function(*map(_columns, vectors), tuple(parameters))
    shape = (*np.broadcast_shapes(*(np.shape(column) for column in columns)), len(columns))
    rows = np.empty_like(vectors[0], np.float64, shape=shape)
    for index, column in enumerate(columns):
        rows[..., index] = column
    return rows


def _of_numbers(function: Callable, vectors: Sequence[Array], parameters: Array) -> Array:
    """A function of numbers, for one vector each.

    Python's own numbers are quicker than NumPy's and overflow without a warning, but do not divide by zero.
    """
    try:
        return np.array(function(*(tuple(vector.tolist()) for vector in vectors), tuple(parameters.tolist())))
    except (ArithmeticError, ValueError):
        with np.errstate(all="ignore"):
            return np.array(function(*map(tuple, vectors), tuple(parameters)))


def _columns(vectors: Array) -> tuple[Array, ...]:
    """The components (...) of vectors (..., n)."""
    return tuple(vectors[..., index] for index in range(vectors.shape[-1]))
