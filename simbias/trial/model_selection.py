"""What a trial's experiments say for each way to model the hardware: held-out log-likelihoods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from simbias.core import Model
from simbias.core.records import Array, Rollout, Transitions
from simbias.learning.prediction_errors import Errors
from simbias.simulation.open_loop import Windows, World, predict
from simbias.trial.study import Study

WINDOW, CHUNKS = 0.1, 10  # s, of a prediction; means over so many parts of it are compared
FOLDS = 3  # fits, each without some of the experiments


class Learned(NamedTuple):
    """What was learned from hardware experiments (lines 13 and 14 of Algorithm 1)."""

    model: Model
    data: Transitions  # D, residuals against the model's nominal model


class Way(NamedTuple):
    """How the hardware is modelled."""

    identifies: bool  # the nominal model's parameters
    corrects: bool  # by a bias


WAYS: Mapping[str, Way] = {  # by name, the simplest first
    "declared models": Way(False, False),
    "identified parameters": Way(True, False),
    "parameters and residual": Way(True, True),
}


def learn(
    study: Study,
    way: Way,
    experiments: Sequence[Rollout],
    taught: Sequence[Sequence[Rollout]],
    data: Transitions | None = None,
) -> Learned:
    """Learn parameters from all experiments, and a bias from those of the iterations that taught.

    Their residuals D may be given; else they are what the study samples.
    """
    nominal = study.identification.fit(study.nominal, experiments) if way.identifies else study.nominal
    data = study.data_from(taught, nominal) if data is None else data
    if not way.corrects:
        return Learned(study.model(None, nominal), data)
    rollouts = [rollout for iteration in taught for rollout in iteration]
    return Learned(study.model(study.bias.learn(data, rollouts, nominal), nominal), data)


def log_likelihoods(study: Study, experiments: Sequence[Rollout]) -> dict[str, float]:
    """Of each way to learn, the mean log-likelihood (nats) of a window that it did not learn from.

    The experiments are left out in turn or, if there are few, their parts. The errors of a window are assumed
    to be distributed as those of the others when these are left out (`simbias.learning.prediction_errors`).
    Errors on what was learned from are too small to tell: the more was learned, the smaller. Nothing if all
    experiments are too short.
    """
    frames = max(1, round(WINDOW / study.task.time_step))
    chunk = max(1, round(frames / CHUNKS))
    folds = _folds(experiments, frames)
    windows = [Windows.of(fold, frames, chunk) for fold in folds]
    values: dict[str, float] = {}
    for name, way in WAYS.items() if len(folds) > 1 else ():
        errors = [
            _errors(study, way, [r for other in folds if other is not fold for r in other], own)
            for fold, own in zip(folds, windows, strict=True)
        ]
        total = 0.0
        for fold, own in enumerate(errors):
            others = [other for other in range(len(folds)) if other != fold]
            seen = Windows.of([r for other in others for r in folds[other]], frames, chunk)
            distribution = Errors.of(np.concatenate([errors[other] for other in others]), seen)
            total += float(distribution.log_likelihoods(own).sum())
        values[name] = total / sum(map(len, errors))
    return values


def likeliest(values: Mapping[str, float]) -> Way:
    """The way to learn whose log-likelihood is the greatest; without any, all that can be learned."""
    return WAYS[max(values, key=lambda name: values[name])] if values else list(WAYS.values())[-1]


def _errors(study: Study, way: Way, kept: Sequence[Rollout], left_out: Windows) -> Array:
    """Errors (w, J, n) of the windows that were left out."""
    model = learn(study, way, kept, [kept]).model
    return predict([World(model.nominal)], left_out, model.bias)[0] - left_out.means


def _folds(experiments: Sequence[Rollout], least: int) -> list[list[Rollout]]:
    """Experiments in up to FOLDS folds; if they are fewer, each is cut into so many parts."""
    whole = [rollout for rollout in experiments if rollout.frames >= least]
    if len(whole) >= FOLDS:
        return [list(whole[fold::FOLDS]) for fold in range(FOLDS)]
    parts: list[list[Rollout]] = [[] for _ in range(FOLDS)]
    for rollout in whole:
        for fold in range(FOLDS):
            begin, end = (rollout.frames * each // FOLDS for each in (fold, fold + 1))
            if end - begin >= least:
                parts[fold].append(_part(rollout, begin, end))
    return [fold for fold in parts if fold]


def _part(rollout: Rollout, begin: int, end: int) -> Rollout:
    """Some frames of an experiment."""
    measured = rollout.measured
    return replace(
        rollout,
        states=rollout.states[begin : end + 1],
        inputs=rollout.inputs[begin:end],
        measured=None if measured is None else measured[begin : end + 1],
        failed_at=end - begin if end == rollout.frames and rollout.failed_at is not None else None,
        failure=rollout.failure if end == rollout.frames else None,
    )
