"""How well models predict recordings, by how far ahead; and how well they know it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from simbias.core import FittedBias, Nominal, Task
from simbias.core.records import Array, Flags, Rollout
from simbias.learning.noise import noise_of
from simbias.simulation.open_loop import PredictionModel, Windows, predict

HORIZONS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # s
SHIFTS = (0.0, 0.5)  # of a window, by which all are shifted for more of them
REGION = 0.9  # probability of a predictive region
DRAWS, SEED = 24, 0  # of the model and of the start, for the spread of a prediction
COMMON = 0.03  # share of the common second moments in the measure of an error
LARGEST_SPREAD = LARGEST_ERROR = 1e6  # in place of one that is not finite
CHANGE = 0.1  # share of the predicted change by which predictions of other recordings may be wrong
EXACT = 1e-4  # of a state's standard deviation: errors that no one asks to be explained
FEWEST = 5  # errors that a region is estimated from, for each state
NARROWEST = 1e-100  # deviation, that of what never moved: its square is a number
SMALLEST, LARGEST = 1e-150, 1e150  # errors: their ratio is a number
MOST_RATIO = 1e3  # of errors, or one over it: what blows up counts as this


@dataclass(frozen=True, eq=False)
class HorizonErrors:
    """Errors of predictions so far ahead, from measured states under measured inputs, by part."""

    seconds: float
    nominal: tuple[Array, ...]  # of each part (w, n)
    identified: tuple[Array, ...]  # by models that were not fitted to the part
    spreads: tuple[Array, ...]  # (w, n, n) of each prediction among models and starts as they may be
    known: HeldOutErrors | None = None  # what regions are estimated from; None: of each part, the other parts
    changes: tuple[Array, ...] = ()  # (w, n) as predicted; none if parts are the known recordings
    noises: tuple[Array, ...] = ()  # (n,) standard deviations of each part's measured states

    @property
    def windows(self) -> int:
        """Number of predictions."""
        return sum(map(len, self.identified))

    def rmse(self) -> tuple[Array, Array]:
        """Root mean square errors (n,) of the nominal model and of the identified one."""
        return _rmse(np.concatenate(self.nominal)), _rmse(np.concatenate(self.identified))

    def ratio(self, part: int | None = None) -> float:
        """Identified over nominal error: the geometric mean over states, of all parts or of one."""
        if part is None:
            return ratio(np.concatenate(self.identified), np.concatenate(self.nominal))
        return ratio(self.identified[part], self.nominal[part])

    def coverage(self) -> float:
        """Share of a part's errors in the 90% region that known ones span; nan if these are too few.

        Regions are wider where small differences grow (`regions`), and for recordings other than the known
        ones by a share of what happens (`of_change`).
        """
        held: list[Flags] = []
        for i, own in enumerate(self.identified):
            known = self.known or self._others(i)
            if len(own) and known.enough:
                region = regions(self.spreads[i], known.errors, known.spreads)
                held.append(inside(own, region + of_change(self.changes[i]) if self.changes else region))
        return float(np.mean(np.concatenate(held))) if held else np.nan

    def unexplained(self) -> float:
        """Errors over those that measurement noise and the model's uncertainty explain: 1 if they are all.

        Their sizes in terms of these, at the quantile that 90% of normal ones do not exceed; nan if they are
        too few.
        """
        each = zip(self.identified, self.spreads, self.noises, strict=True)
        own = np.concatenate([sizes(wrong, spread + np.diag(noise**2)) for wrong, spread, noise in each])
        n = self.identified[0].shape[1]
        if len(own) < FEWEST * n:
            return np.nan
        return float(np.sqrt(np.quantile(own, REGION) / _normal_limit(n)))

    def _others(self, index: int) -> HeldOutErrors:
        """Errors on all parts but one."""
        rest = [j for j in range(len(self.identified)) if j != index]
        errors, spreads = (
            np.concatenate([each[j] for j in rest] or [each[index][:0]])
            for each in (self.identified, self.spreads)
        )
        return HeldOutErrors(errors, spreads)


class HeldOutErrors(NamedTuple):
    """Errors of predictions by models that were not fitted to what they predict."""

    errors: Array  # (v, n)
    spreads: Array  # (v, n, n) of these predictions

    @property
    def enough(self) -> bool:
        """Whether a region can be estimated from them."""
        return len(self.errors) >= FEWEST * self.errors.shape[1] and bool(np.isfinite(self.errors).all())


def predictions(
    task: Task,
    nominal: Nominal,
    identified: Sequence[Nominal],
    parts: Sequence[Sequence[Rollout]],
    learned: Sequence[tuple[Nominal, Sequence[Rollout]]] = (),
) -> list[HorizonErrors]:
    """Predictions of each part by the nominal and by the part's identified model, as far as parts last.

    Regions are estimated from the errors of `learned` models on rollouts that each was not fitted to; without
    these, from those on the other parts.
    """
    longest = min(max(rollout.frames for rollout in part) for part in parts)
    noises = tuple(_noise_of_part(part) for part in parts)

    def ahead(k: int) -> HorizonErrors:
        pairs = list(zip(identified, parts, strict=True))
        wrong = tuple(errors(model, part, k) for model, part in pairs)
        return HorizonErrors(
            float(f"{k * task.time_step:.6g}"),
            tuple(errors(nominal, part, k) for part in parts),
            wrong,
            tuple(spread(model, part, k) for model, part in pairs),
            _known(learned, k) if learned else None,
            tuple(changes(*each, k) for each in zip(wrong, parts, strict=True)) if learned else (),
            noises,
        )

    return [ahead(k) for k in horizons(task, longest)]


def horizons(task: Task, longest: int) -> list[int]:
    """The horizons that are told, in frames, as far as the longest rollout lasts."""
    return [k for k in sorted({task.frames(seconds) for seconds in HORIZONS}) if k <= longest]


def over_recorded(
    task: Task, nominal: Nominal, rollouts: Sequence[Rollout]
) -> Callable[[Sequence[Rollout]], float]:
    """Errors of a model on rollouts as changed, over those as recorded: the mean over states and horizons."""
    ahead = horizons(task, max(rollout.frames for rollout in rollouts))
    recorded = [errors(nominal, rollouts, k) for k in ahead]

    def over(changed: Sequence[Rollout]) -> float:
        pairs = zip(ahead, recorded, strict=True)
        return geometric_mean(np.array([ratio(errors(nominal, changed, k), each) for k, each in pairs]))

    return over


def _known(learned: Sequence[tuple[Nominal, Sequence[Rollout]]], frames: int) -> HeldOutErrors:
    """Errors of models this number of frames ahead, each on the rollouts beside it."""
    wrong, spreads = (
        np.concatenate([of(model, rollouts, frames) for model, rollouts in learned])
        for of in (errors, spread)
    )
    return HeldOutErrors(wrong, spreads)


def _noise_of_part(rollouts: Sequence[Rollout]) -> Array:
    """Standard deviations (n,) of its measured states, at least `EXACT` of their own."""
    states = np.concatenate([rollout.states for rollout in rollouts])
    return np.maximum(noise_of(rollouts), EXACT * np.std(states, axis=0))


def errors(
    nominal: Nominal, rollouts: Sequence[Rollout], frames: int, bias: FittedBias | None = None
) -> Array:
    """Errors (w, n) of predictions this number of frames ahead; infinite where a model has blown up."""
    windows = _windows(rollouts, frames)
    if not windows:
        return np.empty((0, rollouts[0].states.shape[1]))
    wrong = predict([PredictionModel(nominal)], windows, bias)[0, :, -1] - windows.means[:, -1]
    return np.nan_to_num(wrong, nan=np.inf, posinf=np.inf, neginf=-np.inf)


def changes(wrong: Array, rollouts: Sequence[Rollout], frames: int) -> Array:
    """Changes (w, n) of states in this number of frames, as predicted with these errors (w, n)."""
    windows = _windows(rollouts, frames)
    return wrong + windows.means[:, -1] - windows.states[windows.starts] if windows else wrong


def spread(model: Nominal, rollouts: Sequence[Rollout], frames: int, noisy: bool = True) -> Array:
    """Covariance (w, n, n) of each prediction among draws of the model, from starts with noise if `noisy`."""
    windows, n = _windows(rollouts, frames), rollouts[0].states.shape[1]
    if not windows:
        return np.empty((0, n, n))
    rng, noise = np.random.default_rng(SEED), noise_of(rollouts) if noisy else np.zeros(n)
    drawn = [PredictionModel(model.draw(rng), offset=noise * rng.standard_normal(n)) for _ in range(DRAWS)]
    made = predict([PredictionModel(model), *drawn], windows)[:, :, -1]
    e = np.clip(np.nan_to_num(made[1:] - made[0], nan=LARGEST_SPREAD), -LARGEST_SPREAD, LARGEST_SPREAD)
    return np.einsum("kwi,kwj->wij", e, e) / DRAWS


def _windows(rollouts: Sequence[Rollout], frames: int) -> Windows | None:
    """Windows of this number of frames, also shifted by half of it; None if no rollout lasts as long."""
    shifts = sorted({round(share * frames) for share in SHIFTS})
    cut = [r.part(0, r.frames - shift) for r in rollouts for shift in shifts if r.frames - shift >= frames]
    return Windows.of(cut, frames, 1) if cut else None


def regions(spreads: Array, known: Array, known_spreads: Array) -> Array:
    """Covariances (w, n, n) of errors: normal ones of these have the 90% regions that are told.

    Known errors (v, n) scale the spread of predictions, (w, n, n) and (v, n, n), and a little of their own
    second moments, so that regions hold 90% of another such error. That is a larger quantile of few of them
    (V. Vovk, A. Gammerman and G. Shafer, Algorithmic Learning in a Random World, 2005); those of shifted
    windows are not independent. What no known error holds, as other zeros of sensors, is not in them.
    """
    known = np.clip(known, -LARGEST_ERROR, LARGEST_ERROR)
    moments = known.T @ known / len(known)
    independent = len(known) / len(SHIFTS)
    share = min(1.0, np.ceil(REGION * (independent + 1)) / independent)
    limit = np.quantile(sizes(known, known_spreads + COMMON * moments), share)
    return limit / _normal_limit(known.shape[1]) * (spreads + COMMON * moments)


def of_change(changes: Array) -> Array:
    """Covariances (w, n, n) to add for recordings of other motions than the known ones, of changes (w, n).

    A model may be wrong in proportion to what happens, in a way that what it was learned from does not show.
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
    """Root mean squares of errors (w, n) over those of a reference (v, n): the geometric mean over states."""
    return geometric_mean(_ratios(_rmse(wrong), _rmse(reference)))


def _ratios(wrong: Array, reference: Array) -> Array:
    """Sizes of errors (n,) over those of a reference (n,)."""
    both = (np.clip(each, SMALLEST, LARGEST) for each in (wrong, reference))
    return np.clip(np.divide(*both), 1 / MOST_RATIO, MOST_RATIO)


def geometric_mean(values: Array) -> float:
    """That of positive numbers."""
    return float(np.exp(np.mean(np.log(values))))


def _rmse(wrong: Array) -> Array:
    """Root mean squares (n,) of errors (w, n)."""
    return np.sqrt(np.mean(wrong**2, axis=0)) if len(wrong) else np.zeros(wrong.shape[1])


def sizes(wrong: Array, covariances: Array) -> Array:
    """Squared sizes (w,) of errors (w, n) in terms of covariances (w, n, n)."""
    scale = np.maximum(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)), NARROWEST)
    scaled = np.clip(wrong, -LARGEST_ERROR, LARGEST_ERROR) / scale
    correlations = covariances / (scale[:, :, None] * scale[:, None, :])
    return np.einsum("wi,wij,wj->w", scaled, np.linalg.pinv(correlations, hermitian=True), scaled)


def _normal_limit(n: int) -> float:
    """The squared size that 90% of normal errors of n states do not exceed."""
    return float(chdtri(n, 1.0 - REGION))
