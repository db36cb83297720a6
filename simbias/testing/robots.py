"""Checks of task, nominal model, policy and hardware."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simbias.core import Nominal, Policy
from simbias.core.parameters import values_at
from simbias.core.records import Array
from simbias.lab.rates import check_rates, rates_of
from simbias.lab.safety import RECORDED_ROUNDING
from simbias.simulation.compiler import points_of
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.testing.expectations import (
    POINTS,
    check,
    equal,
    expect,
    expect_any_leading_axes,
    inputs,
    near_zero,
    policies,
    robot_states,
    states,
)
from simbias.trial.study import Study

CORNERS = 4  # of a policy's box, tested at each state
EPISODE = 500  # maximum frames of rollouts along which a policy is tested


@check("task", "shapes and names")
def _task_shapes(study: Study) -> None:
    task = study.task
    n, c, q = (len(each) for each in (task.states, task.criteria, task.outputs))
    names = [output.name for output in task.outputs]
    expect(len(set(names)) == q, "task.outputs", "different names", names)
    expect(task.time_step > 0 and task.horizon > 0, "task", "a positive time step and horizon", task.horizon)
    x = states(study)
    equal(np.shape(x), (POINTS, n), "task.draw_start", f"a state of shape ({n},)")
    equal(np.shape(task.measure(x)), (POINTS, c), "task.measure", f"a measure for each of {c} criteria")
    equal(np.shape(task.output(x)), (POINTS, q), "task.output", f"{q} outputs")


@check("task", "any leading axes")
def _task_axes(study: Study) -> None:
    for name in ("measure", "output"):
        method = getattr(study.task, name)
        expect_any_leading_axes(method, f"task.{name}", states(study))


@check("task", "the mean start is not a failure, but a state that is not a number is")
def _task_failure(study: Study) -> None:
    start = study.task.start_mean
    at_start, no_number = (study.task.failure(x) for x in (start, np.full_like(start, np.nan)))
    expect(at_start is None, "task.failure", "none at the mean start", at_start)
    expect(no_number, "task.failure", "one of states that are nan", None)


@check("nominal", "any leading axes")
def _nominal_axes(study: Study) -> None:
    x, u = robot_states(study), inputs(study)
    equal(np.shape(study.nominal.step(x[0], u[0])), np.shape(x[0]), "nominal.step", "a state")
    x_next = study.nominal.step(x, u)
    broken = [row.tolist() for row in np.asarray(x_next) if not np.isfinite(row).all()]
    expect(not broken, "nominal.step", "finite numbers near the start", broken[:1])
    expect_any_leading_axes(study.nominal.step, "nominal.step", x, u)


@check("nominal", "parameters of different names, each of which with_parameters takes in its place")
def _nominal_parameters(study: Study) -> None:
    nominal, x, u = study.nominal, robot_states(study), inputs(study)
    names = [parameter.name for parameter in nominal.parameters]
    expect(len(set(names)) == len(names), "nominal.parameters", "different names", names)
    for each in nominal.parameters:
        known = each.prior != "log_normal" or each.value != 0  # it keeps its sign
        expect(known, "nominal.parameters", f"{each.name} other than 0, log-normal", each.value)
    if names:
        values = np.array([parameter.value for parameter in nominal.parameters])
        others = values_at(nominal.parameters, np.linspace(0.1, 0.2, len(names)))
        declared, other = map(nominal.with_parameters, (values, others))
        expected = "the model itself of its parameters' values"
        equal(declared.step(x, u), nominal.step(x, u), "nominal.with_parameters", expected, 1e-6)
        kept, expected = [each.value for each in other.parameters], f"parameters of values {others}"
        same = np.array_equal(kept, values)  # the priors, which may stay unchanged
        equal(others if same else kept, others, "nominal.with_parameters", expected, 1e-6)
        again, expected = other.with_parameters(others), "the same model of the same values again"
        equal(again.step(x, u), other.step(x, u), "nominal.with_parameters", expected, 1e-6)


@check("nominal", "a model is drawn from the generator alone")
def _nominal_draws(study: Study) -> None:
    x, u = robot_states(study), inputs(study)
    before = study.nominal.step(x, u)
    one, same = (study.nominal.draw(np.random.default_rng(3)).step(x, u) for _ in range(2))
    equal(one, same, "nominal.draw", "the same model from the same generator", 0.0)
    equal(study.nominal.step(x, u), before, "nominal.draw", "the model itself to stay as it is", 0.0)


@check("nominal", "its own state, with any leading axes")
def _nominal_state(study: Study) -> None:
    nominal, x, u = study.nominal, robot_states(study), inputs(study)
    model_state = np.zeros((POINTS, nominal.state_size))
    for t in range(3):  # the rows as frames, starting at zero
        x_next, after = nominal.advance(np.roll(x, t, axis=0), np.roll(u, t, axis=0), model_state)
        equal(np.shape(x_next), x.shape, "nominal.advance", f"states of shape {x.shape}")
        equal(np.shape(after), model_state.shape, "nominal.advance", f"a state of shape {model_state.shape}")
        model_state = after
    equal(np.shape(nominal.acted(u, model_state)), u.shape, "nominal.acting", f"inputs of shape {u.shape}")

    def advance(x: Array, u: Array, before: Array) -> Array:
        return np.concatenate(nominal.advance(x, u, before), axis=-1)

    expect_any_leading_axes(advance, "nominal.advance", x, u, model_state)
    one_by_one = Nominal.model_states(nominal, x, u)
    equal(nominal.model_states(x, u), one_by_one, "nominal.model_states", "that of one frame after the other")
    equal(nominal.along(x, u), nominal.advance(x, u, one_by_one)[0], "nominal.along", "what advance gives")


@check("nominal", "compiled functions give the same numbers")
def _nominal_kernel(study: Study) -> None:
    nominal, x, u = study.nominal, robot_states(study), inputs(study)
    if nominal.kernel is None:
        return
    function, parameters = nominal.kernel
    if nominal.state_size:
        memory = nominal.model_states(x, u)
        each = zip(map(tuple, x), map(tuple, u), map(tuple, memory), strict=True)
        made = [np.concatenate(function(a, b, parameters, c)) for a, b, c in each]
        name, expected = "advance", np.concatenate(nominal.advance(x, u, memory), axis=-1)
    else:
        made = [function(tuple(a), tuple(b), parameters) for a, b in zip(x, u, strict=True)]
        name, expected = "step", nominal.step(x, u)
    equal(np.array(made), expected, f"the kernel of nominal.{name}", "what the method gives")


@check("policy", "bounds")
def _policy_bounds(study: Study) -> None:
    lower, upper = study.policy.bounds
    p = study.policy.n_parameters
    equal((np.shape(lower), np.shape(upper)), ((p,), (p,)), "policy.bounds", f"two arrays ({p},)")
    expect(np.isfinite([lower, upper]).all(), "policy.bounds", "finite numbers", (lower, upper))
    expect((np.asarray(lower) < upper).all(), "policy.bounds", "lower below upper", (lower, upper))


@check("policy", "inputs within their limits, with any leading axes, along episodes")
def _policy_acts(study: Study) -> None:
    policy, x, thetas, m = study.policy, states(study), policies(study), len(study.task.inputs)
    before = np.zeros((POINTS, policy.state_size))
    made = policy.act(thetas, x, 0.0, before)
    both = isinstance(made, tuple | list) and len(made) == 2
    expect(both, "policy.act", "inputs and the policy state", f"one {type(made).__name__}")
    u, after = made
    equal(np.shape(u), (POINTS, m), "policy.act", f"inputs of shape ({POINTS}, {m})")
    equal(np.shape(after), before.shape, "policy.act", f"a policy state of shape {before.shape}")
    expect(not np.isnan(u).any(), "policy.act", "numbers near the start", u)
    far = np.tile(points_of(study.task)[0], (CORNERS, 1))
    corners = np.where(np.random.default_rng(2).random((len(far), thetas.shape[1])) < 0.5, *policy.bounds)
    watched = _Watched(study)
    with np.errstate(all="ignore"):
        watched.act(corners, far, 0.0, np.zeros((len(far), policy.state_size)))
    task = study.task.with_horizon(min(study.task.horizon, EPISODE))
    PlainSimulator([replace(study.model(), task=task, policy=watched)], [None]).rollouts(thetas, x)


class _Watched(Policy):
    """A policy whose inputs are checked against limits and, at times, single against batched evaluation."""

    def __init__(self, study: Study) -> None:
        self._policy, self.state_size = study.policy, study.policy.state_size
        (lower, upper), rounding = study.task.input_bounds, RECORDED_ROUNDING * study.task.input_limit
        self._expected = f"inputs within {lower} and {upper}"
        self._lower, self._upper = lower - rounding, upper + rounding
        self._frames = 0

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        """Inputs (k, m) and the policy state (k, s) of k rollouts."""

        def act(theta: Array, x: Array, policy_state: Array) -> Array:
            return np.concatenate(self._policy.act(theta, x, t, policy_state), axis=-1)

        if not self._frames & (self._frames - 1):  # 0, 1, 2, 4, 8, ...
            rows = np.arange(POINTS) % len(x)
            expect_any_leading_axes(act, "policy.act", theta[rows], x[rows], policy_state[rows])
        self._frames += 1
        u, after = self._policy.act(theta, x, t, policy_state)
        beyond = (u < self._lower) | (u > self._upper)  # far away, it need not be a number
        expect(not beyond.any(), "policy.act", self._expected, u[beyond.any(axis=-1)][:1])
        return u, after


@check("policy", "what imitates inputs is a policy")
def _policy_imitates(study: Study) -> None:
    records = (each.reshape(3, POINTS // 3, -1) for each in (states(study), inputs(study)))
    theta, p = study.policy.imitating(*records), study.policy.n_parameters
    if theta is not None:
        equal(np.shape(theta), (p,), "policy.imitating", f"parameters ({p},)")
        expect(np.isfinite(theta).all(), "policy.imitating", "finite numbers", theta)


@check("policy", "directions of a search near a policy")
def _policy_directions(study: Study) -> None:
    for theta in policies(study)[:CORNERS]:
        made, p = np.asarray(study.policy.directions(theta)), len(theta)
        expect(made.ndim == 2 and made.shape[1] == p, "policy.directions", f"shape (d, {p})", made.shape)
        expect(np.isfinite(made).all(), "policy.directions", "finite numbers", made)
        expect(made.any(axis=1).all(), "policy.directions", "no row of zeros", made)


@check("hardware", "an experiment as the contract says (one is run, from a drawn start)")
def _hardware_runs(study: Study) -> None:
    task, rng = study.task, np.random.default_rng(6)
    made = study.experiment(near_zero(study), rng, task.draw_start(rng))
    lower, upper = task.input_bounds
    within = (lower <= made.inputs) & (made.inputs <= upper)
    expect(within.all(), "hardware.run", "inputs in limits", "others")
    for rate, position in rates_of(task).items():
        x, v = made.states[:, position], made.states[:, rate]
        moves = f"{task.states[position].name} to change while {task.states[rate].name} is not zero"
        expect(bool(np.ptp(x)) or not v[:-1].any(), "hardware.run", moves, f"{x[0]:g} throughout")
    check_rates("hardware.run", [made], task, rates_of(task))
