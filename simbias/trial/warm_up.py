"""Compile the functions that a trial needs, before it begins."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from simbias.core import StudyWarning
from simbias.core.records import Array, Transitions
from simbias.trial.study import Study

SECONDS = 0.2  # of a rollout to learn from, so that the learner is compiled


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
    rollout = study.simulate(theta, fitted_bias)
    if len(data):
        frames = min(study.task.frames(SECONDS), rollout.frames)
        moved = study.of_robot([rollout.part(0, frames)])
        study.bias.learn(data, moved, study.identified(moved))
    study.evaluation.objective(study.model(fitted_bias), study.cost, rng)(theta)
