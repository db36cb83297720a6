"""Model selection by log-likelihoods of held-out experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from simbias.core.records import Array, Rollout
from simbias.learning.prediction_errors import ErrorDistribution, correlation_time
from simbias.simulation.open_loop import PredictionModel, Windows, predict
from simbias.trial.steps import ModelVariant, learn
from simbias.trial.study import Study

WINDOW, CHUNKS = 0.1, 10  # s of a prediction; number of its parts, whose means are compared
FOLDS = 3  # fits, each without some of the experiments


VARIANTS: Mapping[str, ModelVariant] = {  # by name, the simplest first
    "declared models": ModelVariant(False, False),
    "identified parameters": ModelVariant(True, False),
    "parameters and residual": ModelVariant(),
}


def log_likelihoods(study: Study, experiments: Sequence[Rollout], margin: float = 0.0) -> dict[str, float]:
    """Mean log-likelihoods (nats) of a held-out window under each variant, by name.

    For each but the simplest, `margin` standard errors of its gain over the best simpler variant are
    subtracted: few windows may favour a model by chance.

    The experiments are held out in turn or, if there are few, their parts. The errors of a window are assumed
    to have the distribution of the errors in other held-out windows (`simbias.learning.prediction_errors`).
    Errors on training data are too small to compare models: the more a model learned, the smaller they are.
    The result is empty if all experiments are too short.
    """
    frames = max(1, round(WINDOW / study.task.time_step))
    chunk = max(1, round(frames / CHUNKS))
    folds = _folds(experiments, frames)
    windows = [Windows.of(study.of_robot(fold), frames, chunk) for fold in folds]
    values: dict[str, float] = {}
    best, reached = np.zeros(0), 0.0  # its log-likelihoods (w,), and what was subtracted from their mean
    for name, variant in VARIANTS.items() if len(folds) > 1 else ():
        errors = [
            _errors(study, variant, [r for other in folds if other is not fold for r in other], own)
            for fold, own in zip(folds, windows, strict=True)
        ]
        each = []
        for fold, own in enumerate(errors):
            others = [other for other in range(len(folds)) if other != fold]
            seen = Windows.of(study.of_robot(r for other in others for r in folds[other]), frames, chunk)
            distribution = ErrorDistribution.of(np.concatenate([errors[other] for other in others]), seen)
            each.append(distribution.log_likelihoods(own))
        total = sum(float(own.sum()) for own in each)
        of_windows = np.concatenate(each)
        less = reached + margin * _standard_error(of_windows - best, windows) if values else 0.0
        values[name] = total / len(of_windows) - less
        if values[name] == max(values.values()):
            best, reached = of_windows, less
    return values


def _standard_error(gains: Array, folds: Sequence[Windows]) -> float:
    """Standard error of the mean of gains (w,), accounting for correlation of successive windows."""
    e = (gains - gains.mean())[:, None]
    experiments, count = [], 0
    for windows in folds:
        experiments.append(windows.experiments + count)
        count += 1 + max(windows.experiments)
    independent = len(e) / correlation_time(e, np.concatenate(experiments))
    return float(np.sqrt(np.mean(e**2) / max(independent - 1.0, 1e-9)))


def most_likely(values: Mapping[str, float]) -> ModelVariant:
    """The variant with the greatest log-likelihood; without values, the last one."""
    return VARIANTS[max(values, key=lambda name: values[name])] if values else ModelVariant()


def _errors(study: Study, variant: ModelVariant, kept: Sequence[Rollout], left_out: Windows) -> Array:
    """Errors (w, J, n) of a variant on the held-out windows."""
    model = learn(study, kept, [kept], variant).model
    return predict([PredictionModel(model.nominal)], left_out, model.bias)[0] - left_out.means


def _folds(experiments: Sequence[Rollout], least: int) -> list[list[Rollout]]:
    """Split experiments into up to FOLDS folds; if there are fewer, each is cut into FOLDS parts."""
    whole = [rollout for rollout in experiments if rollout.frames >= least]
    if len(whole) >= FOLDS:
        return [list(whole[fold::FOLDS]) for fold in range(FOLDS)]
    parts: list[list[Rollout]] = [[] for _ in range(FOLDS)]
    for rollout in whole:
        for fold in range(FOLDS):
            begin, end = (rollout.frames * each // FOLDS for each in (fold, fold + 1))
            if end - begin >= least:
                parts[fold].append(rollout.part(begin, end))
    return [fold for fold in parts if fold]
