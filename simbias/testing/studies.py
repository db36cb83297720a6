"""Checks of components in combination: identification, warm-up of a trial, longer rollouts."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from simbias.core import Nominal, StudyWarning
from simbias.core.records import Array, Rollout, Transitions
from simbias.testing.expectations import SECONDS, check, equal, expect, inputs, robot_states, rollout
from simbias.trial.study import Study


def _fitted(study: Study, rollouts: Sequence[Rollout]) -> Nominal:
    """The identified model; checks that the nominal one is unchanged."""
    nominal, x, u = study.nominal, robot_states(study), inputs(study)
    parameters, x_next = nominal.parameters, nominal.step(x, u)
    fitted = study.identification.fit(nominal, rollouts)
    expect(isinstance(fitted, Nominal), "fit", "a nominal model", fitted)
    expect(nominal.parameters == parameters, "fit", "the nominal model's parameters to be left", parameters)
    equal(nominal.step(x, u), x_next, "fit", "the nominal model to be left as it is", 0.0)
    return fitted


@check("identification", "without rollouts, the model itself, maybe with motors and sensors of its own")
def _without_rollouts(study: Study) -> None:
    fitted, x, u = _fitted(study, []), robot_states(study), inputs(study)
    kept = {each.name for each in study.nominal.parameters} <= {each.name for each in fitted.parameters}
    expect(kept, "fit", "a model with the nominal model's parameters without rollouts", fitted)
    if not fitted.estimates:  # otherwise it is known from earlier recordings
        expected = "the nominal model's steps without rollouts"
        equal(fitted.step(x, u), study.nominal.step(x, u), "fit", expected)


@check("identification", "finite predictions of a robot that moves and of one at rest, and draws of them")
def _fits_motion_and_rest(study: Study) -> None:
    n = len(study.task.without_targets.states)
    whole, x, u = rollout(study).read_only().of_states(n), robot_states(study), inputs(study)
    frames = min(study.task.frames(SECONDS), whole.frames)
    moving = whole.part(0, frames)
    rest = Rollout(np.tile(whole.states[0], (frames + 1, 1)), np.zeros_like(moving.inputs)).read_only()
    first = _fitted(study, [moving]).step(x, u)
    for recorded in (rest, moving):
        fitted = _fitted(study, [recorded])
        x_next = fitted.step(x, u)
        expect(np.isfinite(x_next).all(), "fit", "a model of finite predictions", x_next)
        one, same = (fitted.draw(np.random.default_rng(3)).step(x, u) for _ in range(2))
        equal(one, same, "draw", "the same model from the same generator", 0.0)
    equal(x_next, first, "fit", "the same model from the same rollouts, whatever was fitted between", 0.0)


@check("identification", "a trial's warm-up: a rollout is simulated, learned from, and a policy evaluated")
def warm_up(study: Study) -> None:
    """Compile the functions that simulated rollouts and searches need."""
    study = replace(study, bias=study.checked_bias)
    theta, rng = np.clip(0.0, *study.policy.bounds), np.random.default_rng(0)
    n, m = len(study.task.without_targets.states), len(study.task.inputs)
    some_data = Transitions(rng.standard_normal((2, n + m)), rng.standard_normal((2, n)))
    _compile(study, study.no_data, theta, rng)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StudyWarning)  # already given
        _compile(study, some_data, theta, rng)  # a fitted bias may have another kernel


def _compile(study: Study, data: Transitions, theta: Array, rng: np.random.Generator) -> None:
    """Compile the functions needed with the bias learned from some data."""
    fitted_bias = study.bias.fit(data)
    simulated = study.simulate(theta, fitted_bias)
    if len(data):
        frames = min(study.task.frames(SECONDS), simulated.frames)
        moved = study.of_robot([simulated.part(0, frames)])
        study.bias.learn(data, moved, study.identified(moved))
    study.evaluation.objective(study.model(fitted_bias), study.cost, rng)(theta)


@check("cost", "the cost of a longer horizon, where the evaluation simulates one (evaluation.seconds)")
def _cost_of_longer_horizon(study: Study) -> None:
    if study.evaluation.horizon is not None:
        cost = study.cost.with_horizon(study.evaluation.horizon).of(rollout(study))
        expect(isinstance(cost, float) and np.isfinite(cost), "with_horizon", "a finite cost", cost)
