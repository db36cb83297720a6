"""Checks of bias, samples, cost and evaluation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simbias.core import Bias, FittedBias, Nominal
from simbias.core.records import Array, Indices, Transitions
from simbias.core.task_checks import drawn_starts, varied_states
from simbias.testing.expectations import (
    POINTS,
    SECONDS,
    check,
    equal,
    expect,
    expect_any_leading_axes,
    expect_arguments_left,
    inputs,
    policies,
    robot_states,
    rollout,
    states,
    transitions,
)
from simbias.trial.study import Study

FAR = 10.0  # from drawn starts: largest change of a state for which a cost is tested
OFF = 1e-3  # of the state: error of a model with known residuals


def _fit(study: Study, data: Transitions) -> FittedBias:
    """The bias that is learned from data."""
    fitted = study.bias.fit(data)
    expect(isinstance(fitted, FittedBias), "fit", "a FittedBias", fitted)
    return fitted


@check("bias", "without data nothing is corrected")
def _bias_without_data(study: Study) -> None:
    fitted, x = _fit(study, study.no_data), robot_states(study)
    equal(fitted.correction(x, inputs(study)), 0.0 * x, "correction", "zeros")


@check("bias", "predictions of data, with any leading axes")
def _bias_predicts(study: Study) -> None:
    data = transitions(study)
    fitted, x, u = _fit(study, data), robot_states(study), inputs(study)
    points = np.concatenate([x, u], axis=1)
    mean, variance = fitted.predict(points)
    for name, given in (("means", mean), ("variances", variance)):
        expect(np.shape(given) == x.shape, "predict", f"{name} of shape {x.shape}", np.shape(given))
    expect((np.asarray(variance) >= 0).all(), "predict", "no negative variance", variance)
    expect(np.isfinite(mean).all(), "predict", "finite means", mean)
    expect_any_leading_axes(fitted.correction, "correction", x, u)
    learned, _ = fitted.predict(data.inputs)
    correction = np.asarray(fitted.correction(*np.split(data.inputs, [x.shape[1]], axis=1)))
    expect(np.isfinite(correction).all(), "correction", "finite numbers", correction)
    expect(np.sum(learned * correction) >= 0, "correction", "the sign of what is predicted", "the opposite")
    again = _fit(study, data).predict(points)
    equal(again, (mean, variance), "fit", "the same from the same data", 0.0)


@check("bias", "the same from the same experiments")
def _bias_learns(study: Study) -> None:
    if type(study.bias).learn is Bias.learn:  # it fits data alone
        return
    whole, x, u = rollout(study).read_only(), robot_states(study), inputs(study)
    frames = min(study.task.frames(SECONDS), whole.frames)
    rollouts = study.of_robot([whole.part(0, frames), whole.part(frames // 2, frames)])
    data, x_next = transitions(study), study.nominal.step(x, u)
    one, same = (study.bias.learn(data, rollouts, study.nominal).correction(x, u) for _ in range(2))
    equal(same, one, "learn", "the same from the same experiments", 0.0)
    equal(study.nominal.step(x, u), x_next, "learn", "the nominal model to be left as it is", 0.0)


@check("bias", "a bias is drawn from the generator alone")
def _bias_draws(study: Study) -> None:
    fitted, x, u = _fit(study, transitions(study)), robot_states(study), inputs(study)
    one, same = (fitted.draw(np.random.default_rng(3)).correction(x, u) for _ in range(2))
    equal(one, same, "draw", "the same bias from the same generator", 0.0)


class _Off(Nominal):
    """A nominal model whose steps miss a thousandth of the state, so that its residuals are known."""

    def __init__(self, nominal: Nominal) -> None:
        self._nominal, self.state_size, self.acting = nominal, nominal.state_size, nominal.acting

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n) with this error."""
        return self._nominal.step(x, u) - OFF * x

    def advance(self, x: Array, u: Array, model_state: Array) -> tuple[Array, Array]:
        """x_next (..., n) with this error, and the model state (..., s) for the next frame."""
        x_next, kept = self._nominal.advance(x, u, model_state)
        return x_next - OFF * x, kept


@check("samples", "residuals, and what is not selected is counted")
def _samples_count(study: Study) -> None:
    rollouts = [rollout(study, seed).read_only() for seed in (0, 1)]
    selection = study.select(rollouts, study.nominal)
    n, m, count = len(study.task.without_targets.states), len(study.task.inputs), len(selection.transitions)
    equal(selection.transitions.inputs.shape, (count, n + m), "samples.select", f"inputs (N, {n + m})")
    equal(selection.transitions.residuals.shape, (count, n), "samples.select", f"residuals (N, {n})")
    frames = sum(each.frames for each in rollouts)
    expect(selection.frames == frames, "samples.select", f"{frames} frames", selection.frames)
    expect(count <= selection.sampled, "samples.select", "no more samples than were looked at", count)
    again = study.select(rollouts, study.nominal).transitions.residuals
    equal(again, selection.transitions.residuals, "samples.select", "the same of the same rollouts", 0.0)
    data = study.select(rollouts, _Off(study.nominal)).transitions
    expected = "residuals x_next - step(x, u) of its inputs (x, u)"
    equal(data.residuals, OFF * data.inputs[:, :n], "samples.select", expected, 1e-6)
    equal(len(study.select([], study.nominal).transitions), 0, "samples.select", "nothing of nothing")


@check("cost", "finite, and nothing of a rollout is changed")
def _cost_is_finite(study: Study) -> None:
    whole = rollout(study)
    cost = study.cost.of(whole)
    expect(isinstance(cost, float) and np.isfinite(cost), "cost.of", "a finite number", cost)
    again = study.cost.of(whole)
    expect(again == cost, "cost.of", f"{cost} of the same rollout again", again)

    def of(states: Array, inputs: Array) -> float:
        return study.cost.of(replace(whole, states=states, inputs=inputs))

    expect_arguments_left(of, "cost.of", whole.states, whole.inputs)
    if study.cost.reductions:  # for many rollouts at once
        t = study.cost.time_step * np.arange(1.0, POINTS + 1)[:, None]

        def terms(x: Array, u: Array, t: Array) -> Array:
            return study.cost.terms(x, u, t[..., 0])

        expect_any_leading_axes(terms, "cost.terms", states(study), inputs(study), t)
        _cost_has_terms(study)


def _cost_has_terms(study: Study) -> None:
    """Expect a number for each reduction, in various states that do not fail."""
    starts = drawn_starts(study.task, np.random.default_rng(0))
    x = np.clip(varied_states(study.task), starts - FAR, starts + FAR)
    robot = len(study.task.without_targets.states)
    x[:, robot:] = starts[:, robot:]  # targets are what the task draws
    x = x[study.task.violated(x) < 0]
    u = np.resize(inputs(study), (len(x), len(study.task.inputs)))
    shape = (len(x), len(study.cost.reductions))
    t = study.cost.time_step * np.arange(1, len(x) + 1)
    with np.errstate(all="ignore"):
        terms = np.asarray(study.cost.terms(x, u, t))
    expected = f"shape {shape} in {shape[0]} frames, for {shape[1]} reductions"
    expect(terms.shape == shape, "cost.terms", expected, terms.shape)
    wrong = np.isnan(terms).any(axis=1)
    words = f"nan, which is left out, in {wrong.sum()} of {len(x)}, such as x = {x[wrong][:1].tolist()}"
    expect(not wrong.any(), "cost.terms", "numbers in states that do not fail", words)


@check("cost", "of many rollouts at once what it is of each", rehearsed=True)
def _cost_of_many(study: Study) -> None:
    rng, cost = np.random.default_rng(7), study.cost
    if not cost.reductions:  # its `of` takes one rollout at a time
        return
    totals = rng.random((POINTS, len(cost.reductions)))
    lost = np.where(np.arange(POINTS) % 2, rng.integers(1, cost.horizon + 1, POINTS), 0)[:, None]

    def of_totals(totals: Array, lost: Indices) -> Array:
        return np.asarray(cost.of_totals(totals, lost[..., 0]))[..., None]

    expect_any_leading_axes(of_totals, "cost.of_totals", totals, lost)


@check("cost", "an early fall costs more than Z_max")
def _cost_of_failure(study: Study) -> None:
    whole = rollout(study)
    fallen = replace(
        whole,
        states=whole.states[:2],
        inputs=whole.inputs[:1],
        measured=None,
        failed_at=1,
        failure=study.task.criteria[0].name if study.task.criteria else "failed",
    )
    cost, limit = study.cost.of(fallen), study.cost.max_cost
    expect(cost > limit, "cost.of", f"more than Z_max = {limit:g} of a rollout that falls in frame 1", cost)


@check("evaluation", "a finite cost, the same each time and together")
def _evaluation_is_deterministic(study: Study) -> None:
    model, thetas = study.model(), policies(study)[:3]
    objective, same = (
        study.evaluation.objective(model, study.cost, np.random.default_rng(4)) for _ in range(2)
    )
    costs = np.array([objective(theta) for theta in thetas])
    expect(np.isfinite(costs).all(), "objective", "finite costs", costs)
    equal([same(theta) for theta in thetas], costs, "objective", "the same from the same generator", 0.0)
    equal(objective(thetas[0]), costs[0], "objective", "the same when it is asked again", 0.0)
    if hasattr(objective, "together"):
        equal(objective.together(thetas), costs, "objective.together", "the costs of each alone", 0.0)
