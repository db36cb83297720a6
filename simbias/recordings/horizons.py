"""Prediction errors of models on recordings, by horizon, and the calibration of their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from simbias.core import FittedBias, Nominal, Task
from simbias.core.records import Array, Flags, Rollout
from simbias.learning.noise import noise_of
from simbias.simulation.open_loop import PredictionModel, Windows, predict

HORIZONS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # s
SHIFTS = (0.0, 0.5)  # of a window: shifts that give additional windows
REGION = 0.9  # probability of a predictive region
DRAWS, SEED = 24, 0  # of the model and of the start, for the spread of a prediction
COMMON = 0.03  # share of common second moments in the metric of an error
LARGEST_SPREAD = LARGEST_ERROR = 1e6  # replaces a non-finite one
CHANGE = 0.1  # share of the predicted change: allowed error on other recordings
EXACT = 1e-4  # of a state's standard deviation: smaller errors need no explanation
FEWEST = 5  # errors needed per state to estimate a region
NARROWEST = 1e-100  # deviation of a state that never moved; its square does not underflow
SMALLEST, LARGEST = 1e-150, 1e150  # errors; their ratio is finite
MOST_RATIO = 1e3  # of errors, or its inverse; a divergence counts as this


class ModelErrors(NamedTuple):
    """Errors of a model's predictions of rollouts at one horizon, and what explains them."""

    errors: Array  # (w, n)
    spreads: Array  # (w, n, n) of each prediction, over drawn models and starts
    noise: Array  # (n,) standard deviations of noise in measured states, at least `EXACT` of the states' own
    changes: Array  # (w, n) predicted changes of states

    @staticmethod
    def of(model: Nominal, rollouts: Sequence[Rollout], frames: int) -> ModelErrors:
        """Errors of a model this number of frames ahead."""
        wrong = errors(model, rollouts, frames)
        deviations = np.std(np.concatenate([rollout.states for rollout in rollouts]), axis=0)
        noise = np.maximum(noise_of(rollouts), EXACT * deviations)
        return ModelErrors(wrong, spread(model, rollouts, frames), noise, changes(wrong, rollouts, frames))


@dataclass(frozen=True, eq=False)
class HorizonErrors:
    """Prediction errors at one horizon, from measured states under measured inputs, by part."""

    seconds: float
    nominal: tuple[Array, ...]  # (w, n) for each part
    identified: tuple[ModelErrors, ...]  # of models not fitted to the part
    known: tuple[ModelErrors, ...] = ()  # those that give regions; without any, for each part, the others
    own: tuple[ModelErrors, ...] = ()  # of models with own values of a recording's specific parameters

    @property
    def windows(self) -> int:
        """Number of predictions."""
        return len(self._wrong)

    @property
    def _wrong(self) -> Array:
        """Errors (w, n) of the identified models on all parts."""
        return np.concatenate([each.errors for each in self.identified])

    def rmse(self) -> tuple[Array, Array]:
        """Root mean square errors (n,) of the nominal model and of the identified one."""
        return _rmse(np.concatenate(self.nominal)), _rmse(self._wrong)

    def ratio(self, part: int | None = None) -> float:
        """Identified over nominal error: the geometric mean over states, of all parts or of one."""
        if part is None:
            return ratio(self._wrong, np.concatenate(self.nominal))
        return ratio(self.identified[part].errors, self.nominal[part])

    def coverage(self) -> float:
        """Share of errors in the 90% regions estimated from known errors; nan if these are too few.

        Regions are wider where small differences grow (`regions`) and, for recordings other than the known
        ones, by a share of the predicted change (`of_change`).
        """
        held: list[Flags] = []
        for i, own in enumerate(self.identified):
            known = self.known or self.identified[:i] + self.identified[i + 1 :]
            wrong = np.concatenate([own.errors[:0], *(each.errors for each in known)])
            enough = len(wrong) >= FEWEST * wrong.shape[1] and np.isfinite(wrong).all()
            if len(own.errors) and enough:
                region = regions(own.spreads, wrong, np.concatenate([each.spreads for each in known]))
                held.append(inside(own.errors, region + of_change(own.changes) if self.known else region))
        return float(np.mean(np.concatenate(held))) if held else np.nan

    def unexplained(self) -> float:
        """Ratio of errors to those explained by noise and model uncertainty; 1 if fully explained.

        Sizes in the metric of these are compared at the 90% quantile of normal errors; nan if there are too
        few.
        """
        each = self.own or self.identified
        own = np.concatenate([sizes(one.errors, one.spreads + np.diag(one.noise**2)) for one in each])
        n = len(each[0].noise)
        if len(own) < FEWEST * n:
            return np.nan
        return float(np.sqrt(np.quantile(own, REGION) / _normal_limit(n)))

    def least_explained(self) -> int:
        """The state whose errors are the largest ones relative to what explains them."""
        shares = [
            np.minimum(np.abs(one.errors), LARGEST)
            / np.sqrt(np.diagonal(one.spreads, axis1=1, axis2=2) + one.noise**2 + NARROWEST)
            for one in self.own or self.identified
        ]
        return int(np.argmax(np.quantile(np.concatenate(shares), REGION, axis=0)))


def predictions(
    task: Task,
    nominal: Nominal,
    identified: Sequence[Nominal],
    parts: Sequence[Sequence[Rollout]],
    learned: Sequence[tuple[Nominal, Sequence[Rollout]]] = (),
    own: Sequence[tuple[Nominal, Sequence[Rollout]]] = (),
) -> list[HorizonErrors]:
    """Prediction errors of the nominal model and of each part's identified model, by horizon.

    Regions are estimated from the errors of `learned` models on rollouts held out from each; without these,
    from errors on the other parts. Models with `own` values of a recording's specific parameters, each with
    the recording, tell how far errors are explained.
    """
    longest = min(max(rollout.frames for rollout in part) for part in parts)
    pairs = [*zip(identified, parts, strict=True)], learned, own
    return [
        HorizonErrors(
            float(f"{k * task.time_step:.6g}"),
            tuple(errors(nominal, part, k) for part in parts),
            *(tuple(ModelErrors.of(*pair, k) for pair in each) for each in pairs),
        )
        for k in horizons(task, longest)
    ]


def horizons(task: Task, longest: int) -> list[int]:
    """The reported horizons in frames, up to the duration of the longest rollout."""
    return [k for k in sorted({task.frames(seconds) for seconds in HORIZONS}) if k <= longest]


def over_changes(task: Task, nominal: Nominal, rollouts: Sequence[Rollout]) -> float:
    """Ratio of a model's errors to the recorded changes of the states: mean over states and horizons."""
    ratios = []
    for k in horizons(task, max(rollout.frames for rollout in rollouts)):
        wrong = errors(nominal, rollouts, k)
        ratios.append(ratio(wrong, changes(np.zeros_like(wrong), rollouts, k)))
    return geometric_mean(np.array(ratios))


def errors(
    nominal: Nominal, rollouts: Sequence[Rollout], frames: int, bias: FittedBias | None = None
) -> Array:
    """Errors (w, n) of predictions this number of frames ahead; infinite where a model has diverged."""
    windows = _windows(rollouts, frames)
    if not windows:
        return np.empty((0, rollouts[0].states.shape[1]))
    wrong = predict([PredictionModel(nominal)], windows, bias)[0, :, -1] - windows.means[:, -1]
    return np.nan_to_num(wrong, nan=np.inf, posinf=np.inf, neginf=-np.inf)


def changes(wrong: Array, rollouts: Sequence[Rollout], frames: int) -> Array:
    """Predicted changes (w, n) of states in this number of frames, from prediction errors (w, n)."""
    windows = _windows(rollouts, frames)
    return wrong + windows.means[:, -1] - windows.states[windows.starts] if windows else wrong


def spread(model: Nominal, rollouts: Sequence[Rollout], frames: int, noisy: bool = True) -> Array:
    """Covariance (w, n, n) of each prediction over draws of the model, with noisy starts if `noisy`."""
    windows, n = _windows(rollouts, frames), rollouts[0].states.shape[1]
    if not windows:
        return np.empty((0, n, n))
    rng, noise = np.random.default_rng(SEED), noise_of(rollouts) if noisy else np.zeros(n)
    drawn = [PredictionModel(model.draw(rng), offset=noise * rng.standard_normal(n)) for _ in range(DRAWS)]
    made = predict([PredictionModel(model), *drawn], windows)[:, :, -1]
    e = np.clip(np.nan_to_num(made[1:] - made[0], nan=LARGEST_SPREAD), -LARGEST_SPREAD, LARGEST_SPREAD)
    return np.einsum("kwi,kwj->wij", e, e) / DRAWS


def _windows(rollouts: Sequence[Rollout], frames: int) -> Windows | None:
    """Windows of this number of frames, also shifted by half; None if no rollout is long enough."""
    shifts = sorted({round(share * frames) for share in SHIFTS})
    cut = [r.part(0, r.frames - shift) for r in rollouts for shift in shifts if r.frames - shift >= frames]
    return Windows.of(cut, frames, 1) if cut else None


def regions(spreads: Array, known: Array, known_spreads: Array) -> Array:
    """Covariances (w, n, n) of errors; their normal 90% regions are the reported ones.

    Known errors (v, n) scale the spread of predictions, (w, n, n) and (v, n, n), plus a small share of their
    own second moments, so that regions contain a new such error with 90% probability. With few errors, this
    is a larger quantile of them (V. Vovk, A. Gammerman and G. Shafer, Algorithmic Learning in a Random World,
    2005); errors of shifted windows are not independent. Effects absent from known errors, such as other
    sensor zeros, are not covered.
    """
    known = np.clip(known, -LARGEST_ERROR, LARGEST_ERROR)
    moments = known.T @ known / len(known)
    independent = len(known) / len(SHIFTS)
    share = min(1.0, np.ceil(REGION * (independent + 1)) / independent)
    limit = np.quantile(sizes(known, known_spreads + COMMON * moments), share)
    return limit / _normal_limit(known.shape[1]) * (spreads + COMMON * moments)


def of_change(changes: Array) -> Array:
    """Covariances (w, n, n) to add for recordings of motions other than the known ones, from changes (w, n).

    A model may have errors proportional to the change that its training data do not show.
    """
    deviations = CHANGE * np.clip(changes, -LARGEST_ERROR, LARGEST_ERROR)
    return deviations[:, :, None] ** 2 * np.eye(changes.shape[1])


def inside(wrong: Array, covariances: Array) -> Flags:
    """Which errors (w, n) lie in the 90% regions of their covariances (w, n, n)."""
    return sizes(wrong, covariances) <= _normal_limit(wrong.shape[1])


def overall(made: Sequence[HorizonErrors], part: int | None = None) -> float:
    """Identified over nominal error: the geometric mean over states and horizons."""
    return geometric_mean(np.array([prediction.ratio(part) for prediction in made]))


def by_state(made: Sequence[HorizonErrors]) -> Array:
    """Identified over nominal error of each state (n,): the geometric mean over horizons."""
    return np.exp(np.mean([np.log(_ratios(*prediction.rmse()[::-1])) for prediction in made], axis=0))


def ratio(wrong: Array, reference: Array) -> float:
    """Root mean squares of errors (w, n) relative to a reference (v, n): geometric mean over states."""
    return geometric_mean(_ratios(_rmse(wrong), _rmse(reference)))


def _ratios(wrong: Array, reference: Array) -> Array:
    """Ratios (n,) of error sizes (n,) to those of a reference (n,)."""
    both = (np.clip(each, SMALLEST, LARGEST) for each in (wrong, reference))
    return np.clip(np.divide(*both), 1 / MOST_RATIO, MOST_RATIO)


def geometric_mean(values: Array) -> float:
    """The geometric mean of positive numbers."""
    return float(np.exp(np.mean(np.log(values))))


def _rmse(wrong: Array) -> Array:
    """Root mean squares (n,) of errors (w, n)."""
    return np.sqrt(np.mean(wrong**2, axis=0)) if len(wrong) else np.zeros(wrong.shape[1])


def sizes(wrong: Array, covariances: Array) -> Array:
    """Squared Mahalanobis norms (w,) of errors (w, n), for covariances (w, n, n)."""
    scale = np.maximum(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)), NARROWEST)
    scaled = np.clip(wrong, -LARGEST_ERROR, LARGEST_ERROR) / scale
    correlations = covariances / (scale[:, :, None] * scale[:, None, :])
    return np.einsum("wi,wij,wj->w", scaled, np.linalg.pinv(correlations, hermitian=True), scaled)


def _normal_limit(n: int) -> float:
    """The 90% quantile of the squared norm of normal errors in n states."""
    return float(chdtri(n, 1.0 - REGION))
