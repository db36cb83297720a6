"""Policies that imitate linear-quadratic regulators (LQR) of the model.

Costs of falling policies say little about which policies do not fall. For the model linearised at an
equilibrium, near zero or at a resting goal elsewhere, theory gives a regulator. It uses the whole state,
including the model state of a delay or a lag. A policy with less information imitates it.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from simbias.core import Model, StudyWarning
from simbias.core.records import MEMORY, Array
from simbias.simulation.goal import held, resting_goal
from simbias.simulation.linearization import STEP, advanced, derivatives, input_scale, linear_regulator

INPUT_WEIGHTS = (10.0, 100.0, 1000.0, 10000.0)  # R of inputs at their limits; Q of a state of one unit is 1
MODEL_STATE_WEIGHT = 1e-9  # Q of the model state
STEADY = 0.03  # share of the input limits: steady disturbance in records of a regulator with an integral
NEAR = 1e-3  # weight of the distance from zero, relative to accelerations: selects the nearest equilibrium
OF_INPUTS = 1e-2  # of this weight, for inputs that hold a goal
NEARER = 1e-6  # weight of the distance from a goal, relative to changes per frame: slow drifts stop too
RECORDS, SECONDS = 16, 1.0  # imitated records of the regulated model, and the duration of each,
EXCITATION = 0.01  # with random inputs of this share of the limits
SEED = 0  # of these records, so that the same model gives the same policies
CLOSE = 0.1  # relative deviation from the goal: so small that a constant input matters
ALIKE = 0.5  # of the squared inputs: allowed squared error of a policy there
DIGITS = 9  # decimals of states at rest, in their units
NO_ERRORS = (
    "its outputs are not zero at the goal (position - 0.5 is), and it has no constant (as policy.constant of "
    "dynamic_output_feedback)"
)
INTEGRATED = "it integrates outputs that are not zero at the goal; name others in policy.integrated"
STEADY_INPUT = (
    "{} has no constant for the steady input that holds the robot, so it rests elsewhere; "
    "use policy.constant of dynamic_output_feedback, or method=lqi"
)


class Linear(NamedTuple):
    """A model linearised at rest: s' - s_0 = A (s - s_0) + B (u - u_0), with s states, then model state."""

    A: Array  # (l, l)
    B: Array  # (l, m)
    rest: Array  # s_0 (l,)
    inputs: Array  # u_0 (m,)
    states: int  # n
    Q: Array  # (l, l) weight of s
    steady: float = 0.0  # share of the inputs' limits of a steady disturbance in its records


def lqr_candidates(model: Model, count: int) -> Iterator[Array]:
    """LQR policies (p,) of `count` models to try first: the most probable one, and draws of its parameters.

    They are designed with sticking joints, as in the published trials. A replayed search requests none, so
    none is designed.
    """
    rngs = np.random.default_rng(SEED).spawn(max(count - 1, 0))
    models = [model, *(replace(model, nominal=model.nominal.draw(rng)) for rng in rngs)][:count]
    policies = [theta for each in models for theta in lqr_policies(each, sticking=True)]
    if models and not policies:
        warnings.warn(f"searches begin without LQR: {why_none(model, 'none')}", StudyWarning, stacklevel=2)
    yield from policies


def why_none(model: Model, regulator: str, integral: bool = False) -> str:
    """Why no policy imitates a model's regulator, with or without an integral."""
    if model.task.targets:
        return "targets need another regulator at each start"
    policy = type(model.policy).__name__
    if integral and not model.policy.integrated(np.zeros(len(model.task.states))).size:
        return f"{policy} integrates nothing; use dynamic_output_feedback with policy.integral_rate above 0"
    return f"{policy} imitates {regulator}, or the model has none"


def lqr_policies(
    model: Model,
    input_weights: Sequence[float] = INPUT_WEIGHTS,
    integral_weight: float = 0.0,
    sticking: bool = False,
) -> list[Array]:
    """Policies (p,) that imitate the LQR of each weight, if the model has one.

    With an integral weight it is LQI: the integrals of the policy's integrated quantities are states too. The
    model is linearised with sliding joints: at rest, dry friction looks like damping, which is absent in
    motion; regulators that rely on it fall. `sticking` linearises at rest nevertheless, and lets gains
    compensate for a constant input that a policy lacks, as in the published trials.
    """
    if model.task.targets:  # the setpoint changes with each start
        return []
    if not sticking:
        model = replace(model, nominal=model.nominal.without_dry_friction())
    goal = resting_goal(model.task)
    policies = _regulating(model, goal, input_weights, integral_weight, sticking)
    if isinstance(policies, str):
        why = f"{type(model.policy).__name__} cannot hold the goal as LQR does, so it regulates to zero: "
        warnings.warn(why + policies, StudyWarning, stacklevel=2)
        policies = _regulating(model, None, input_weights, integral_weight, sticking)
    return [] if isinstance(policies, str) else policies


def _regulating(
    model: Model, goal: Array | None, input_weights: Sequence[float], integral_weight: float, sticking: bool
) -> list[Array] | str:
    """Policies (p,) that imitate regulators to a goal (n,) or zero; if they cannot at a goal, why.

    If the equilibrium needs a steady input that the policy cannot give, they imitate only the feedback. An
    integral then finds the steady input; without one, they rest elsewhere.
    """
    try:
        linear = linearised(model, _place_to_rest(model, goal, sticking))
        if integral_weight:
            linear = _with_integrals(model, linear, integral_weight)
    except (ValueError, np.linalg.LinAlgError):  # a drawn model may not be finite even at rest
        return []
    limit = input_scale(model.task)
    each = [lqr_gains(linear, weight * np.diag(limit**-2.0)) for weight in input_weights]
    found = [gains for gains in each if gains is not None]
    offset = not sticking and _needs_a_constant(model, linear, goal)
    if offset:
        linear = _without_steady_input(linear, goal)
    imitations = [model.policy.imitating(*record) for record in _records(model, linear, found)]
    policies = [theta for theta in imitations if theta is not None]
    if policies and goal is not None:
        integrated = model.policy.integrated(goal) if integral_weight else np.zeros(0)
        if (np.abs(integrated) > NEAR).any():
            return INTEGRATED
        if not _is_imitated(model, linear, found[0], goal):
            return NO_ERRORS
    if policies and offset and not integral_weight:
        warnings.warn(STEADY_INPUT.format(type(model.policy).__name__), StudyWarning, stacklevel=3)
    return policies


def _place_to_rest(model: Model, goal: Array | None, sticking: bool) -> Array | None:
    """The states (n,) to rest at: a goal, or zero if inputs can hold it; None: nearest to zero."""
    zero = np.zeros(len(model.task.states))
    return zero if goal is None and not sticking and held(model.task, model.nominal, zero) else goal


def _needs_a_constant(model: Model, linear: Linear, goal: Array | None) -> bool:
    """Whether the equilibrium needs steady inputs that the policy cannot give at the states around it."""
    u, x = linear.inputs, linear.rest[: linear.states] if goal is None else goal
    if (np.abs(u) <= NEAR * input_scale(model.task)).all():
        return False
    states = x + np.random.default_rng(SEED).standard_normal((1, RECORDS * len(x), len(x)))
    return not _acts(model, states, np.tile(u, (*states.shape[:-1], 1)), u)


def _without_steady_input(linear: Linear, goal: Array | None) -> Linear:
    """The model as if it were at rest at a goal (n,), or zero, without input."""
    rest = linear.rest.copy()
    rest[: linear.states] = 0.0 if goal is None else goal
    return linear._replace(rest=rest, inputs=np.zeros_like(linear.inputs))


def _is_imitated(model: Model, linear: Linear, gains: Array, goal: Array) -> bool:
    """Whether the policy can imitate a regulator K (m, l) near a nonzero goal (n,)."""
    n = linear.states
    off = CLOSE * np.random.default_rng(SEED).standard_normal((1, RECORDS, 1)) * goal
    states, inputs = linear.rest[:n].round(DIGITS) + off, linear.inputs - off @ gains[:, :n].T
    return _acts(model, states, inputs, np.clip(inputs, *model.task.input_bounds) - linear.inputs)


def _acts(model: Model, states: Array, inputs: Array, added: Array) -> bool:
    """Whether the policy can give inputs (1, k, m) at states (1, k, n), with errors small against `added`."""
    theta = model.policy.imitating(states, inputs)
    if theta is None:
        return False
    u, _ = model.policy.act(theta, states, 0.0, np.zeros((*states.shape[:-1], model.policy.state_size)))
    wrong = u - np.clip(inputs, *model.task.input_bounds)
    return bool(np.mean(wrong**2) <= ALIKE * np.mean(added**2))


def rest(
    model: Model, near: Array | None = None, any_input: bool = False, exactly: bool = False
) -> tuple[Array, Array]:
    """The equilibrium states (n,) and inputs (m,) nearest to zero, or to states (n,) with zero input.

    If `any_input`, the states are as near as possible, whatever input this takes. Slow drifts are excluded
    only if `exactly`.
    """
    from scipy.optimize import least_squares  # lazily: few searches begin with LQR

    task, limit = model.task, input_scale(model.task)
    n, rates = len(task.states), 1 / task.time_step
    begin = np.zeros(n + len(task.inputs))
    begin[:n] = 0.0 if near is None else near
    pulls = np.ones(len(begin))
    if any_input:
        pulls[n:] = OF_INPUTS

    def residuals(both: Array, scale: float, weight: float) -> Array:
        x, u = both[:n], both[n:] * limit
        moved = model.nominal.step(x, u) + model.bias.correction(x, u) - x
        return np.concatenate([scale * moved, weight * pulls * (both - begin)])

    with np.errstate(all="ignore"):  # the search tries extreme values
        found = least_squares(residuals, begin, xtol=1e-12, ftol=1e-12, args=(rates, NEAR)).x
        if exactly:
            found = least_squares(residuals, found, xtol=1e-12, ftol=1e-12, gtol=None, args=(1.0, NEARER)).x
    return found[:n], found[n:] * limit


def linearised(model: Model, goal: Array | None = None) -> Linear:
    """The corrected model, linearised by central differences at rest near zero or a goal (n,)."""
    x, u = rest(model, goal, any_input=goal is not None, exactly=goal is not None)
    n, size, limit = len(x), model.nominal.state_size, input_scale(model.task)
    model_state = model.nominal.model_states(np.tile(x, (MEMORY, 1)), np.tile(u, (MEMORY, 1)))[-1]
    point = np.concatenate([x, model_state, u])
    steps = STEP * np.concatenate([np.ones(n + size), limit])
    slopes = derivatives(partial(advanced, model.nominal, model.bias, n), point, steps)
    Q = np.diag(np.concatenate([np.ones(n), np.full(size, MODEL_STATE_WEIGHT)]))
    return Linear(slopes[:, : n + size], slopes[:, n + size :], point[: n + size], u, n, Q)


def _with_integrals(model: Model, linear: Linear, weight: float) -> Linear:
    """The model with the time integrals of the policy's integrated quantities appended to its states."""
    x, steps = linear.rest[: linear.states], np.full(linear.states, STEP)
    if not model.policy.integrated(x).size:
        raise ValueError("the policy integrates nothing")
    slopes = derivatives(model.policy.integrated, x, steps)
    C = np.pad(slopes, ((0, 0), (0, len(linear.A) - linear.states)))  # (i, l)
    i = len(C)
    return linear._replace(
        A=np.block([[linear.A, np.zeros((len(linear.A), i))], [model.task.time_step * C, np.eye(i)]]),
        B=np.pad(linear.B, ((0, i), (0, 0))),
        rest=np.concatenate([linear.rest, np.zeros(i)]),
        Q=block_diag(linear.Q, weight * np.eye(i)),
        steady=STEADY,
    )


def lqr_gains(linear: Linear, R: Array) -> Array | None:
    """K (m, l) of u = u_0 - K (s - s_0), which minimises the sum of |x - x_0|^2 + u R u, or None."""
    try:
        return linear_regulator(linear.A, linear.B, linear.Q, R)[0]
    except (np.linalg.LinAlgError, ValueError):
        return None


def _records(model: Model, linear: Linear, gains: Sequence[Array]) -> list[tuple[Array, Array]]:
    """Records of the linear model under each K (m, l): states (k, T, n) and inputs (k, T, m).

    The records begin at the task's starts, and random inputs excite the model.
    """
    task, limit, rng = model.task, input_scale(model.task), np.random.default_rng(SEED)
    n, m, frames, r = len(task.states), len(task.inputs), task.frames(SECONDS), len(gains)
    s, excitation = np.zeros((r, RECORDS, len(linear.rest))), np.empty((r, frames, RECORDS, m))
    for one, noise in zip(s, excitation, strict=True):
        one[:, :n] = [task.draw_start(rng) - linear.rest[:n] for _ in range(RECORDS)]
        noise[:] = EXCITATION * limit * rng.standard_normal(noise.shape)
        if linear.steady:
            noise += linear.steady * limit * rng.standard_normal((RECORDS, m))
    states, inputs = np.empty((frames, r, RECORDS, n)), np.empty((frames, r, RECORDS, m))
    K = -np.reshape(gains, (r, m, s.shape[-1])).transpose(0, 2, 1)
    for t in range(frames):
        states[t] = s[..., :n]
        inputs[t] = u = s @ K
        s = s @ linear.A.T + (u + excitation[:, t]) @ linear.B.T
    states, inputs = states + linear.rest[:n], inputs + linear.inputs
    return list(zip(np.moveaxis(states, 0, 2), np.moveaxis(inputs, 0, 2), strict=True))
