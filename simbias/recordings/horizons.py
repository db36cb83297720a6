"""How well models predict recordings, by how far ahead; and how well they know it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simbias.core import FittedBias, Nominal, Task
from simbias.core.records import Array, Flags, Rollout
from simbias.recordings.noise import noise_of
from simbias.simulation.open_loop import PredictionModel, Windows, predict

HORIZONS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # s
SHIFTS = (0.0, 0.5)  # of a window, by which all are shifted for more of them
REGION = 0.9  # probability of a predictive region
DRAWS, SEED = 24, 0  # of the model and of the start, for the spread of a prediction
COMMON = 0.03  # share of the common second moments in the measure of an error
LARGEST_SPREAD = 1e6  # deviation, in place of one that is not finite
FEWEST = 5  # errors that a region is estimated from, for each state
SMALLEST, LARGEST = 1e-150, 1e150  # errors: their ratio is a number
MOST_RATIO = 1e3  # of errors, or one over it: what blows up counts as this


@dataclass(frozen=True, eq=False)
class Prediction:
    """Errors of predictions so far ahead, from measured states under measured inputs, by part."""

    seconds: float
    nominal: tuple[Array, ...]  # of each part (w, n)
    identified: tuple[Array, ...]  # by models that were not fitted to the part
    spreads: tuple[Array, ...]  # (w, n, n) of each prediction among models and starts as they may be

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
        """Share of a part's errors in the 90% region that those of the other parts span; nan if too few.

        Errors are measured by their prediction's spread, and a little of the other parts' second moments; the
        region holds 90% of the other parts' errors. So it is wider where small differences grow.
        """
        held: list[Flags] = []
        for i, own in enumerate(self.identified):
            rest = [j for j in range(len(self.identified)) if j != i]
            known, spreads = (
                np.concatenate([each[j] for j in rest] or [each[i][:0]])
                for each in (self.identified, self.spreads)
            )
            if len(own) and len(known) >= FEWEST * own.shape[1] and np.isfinite(known).all():
                held.append(inside(own, self.spreads[i], known, spreads))
        return float(np.mean(np.concatenate(held))) if held else np.nan


def predictions(
    task: Task, nominal: Nominal, identified: Sequence[Nominal], parts: Sequence[Sequence[Rollout]]
) -> list[Prediction]:
    """Predictions of each part by the nominal and by the part's identified model, as far as parts last."""
    longest = min(max(rollout.frames for rollout in part) for part in parts)
    frames = {seconds: task.frames(seconds) for seconds in HORIZONS}
    return [
        Prediction(
            seconds,
            tuple(errors(nominal, part, k) for part in parts),
            tuple(errors(model, part, k) for model, part in zip(identified, parts, strict=True)),
            tuple(spread(model, part, k) for model, part in zip(identified, parts, strict=True)),
        )
        for seconds, k in frames.items()
        if k <= longest and k > frames.get(_before(seconds), 0)
    ]


def errors(
    nominal: Nominal, rollouts: Sequence[Rollout], frames: int, bias: FittedBias | None = None
) -> Array:
    """Errors (w, n) of predictions this number of frames ahead; infinite where a model has blown up."""
    windows = _windows(rollouts, frames)
    if not windows:
        return np.empty((0, rollouts[0].states.shape[1]))
    wrong = predict([PredictionModel(nominal)], windows, bias)[0, :, -1] - windows.means[:, -1]
    return np.nan_to_num(wrong, nan=np.inf, posinf=np.inf, neginf=-np.inf)


def spread(model: Nominal, rollouts: Sequence[Rollout], frames: int) -> Array:
    """Covariance (w, n, n) of each prediction among draws of the model, from starts with noise."""
    windows, n = _windows(rollouts, frames), rollouts[0].states.shape[1]
    if not windows:
        return np.empty((0, n, n))
    rng, noise = np.random.default_rng(SEED), noise_of(rollouts)
    drawn = [PredictionModel(model.draw(rng), offset=noise * rng.standard_normal(n)) for _ in range(DRAWS)]
    made = predict([PredictionModel(model), *drawn], windows)[:, :, -1]
    e = np.clip(np.nan_to_num(made[1:] - made[0], nan=LARGEST_SPREAD), -LARGEST_SPREAD, LARGEST_SPREAD)
    return np.einsum("kwi,kwj->wij", e, e) / DRAWS


def _windows(rollouts: Sequence[Rollout], frames: int) -> Windows | None:
    """Windows of this number of frames, also shifted by half of it; None if no rollout lasts as long."""
    shifts = sorted({round(share * frames) for share in SHIFTS})
    cut = [
        Rollout(r.states[: len(r.states) - shift], r.inputs[: len(r.inputs) - shift])
        for r in rollouts
        for shift in shifts
        if r.frames - shift >= frames
    ]
    return Windows.of(cut, frames, 1) if cut else None


def inside(wrong: Array, spreads: Array, known: Array, known_spreads: Array) -> Flags:
    """Which errors (w, n), of spreads (w, n, n), lie in the 90% region of known ones (v, n), (v, n, n)."""
    moments = known.T @ known / len(known)
    limit = np.quantile(_sizes(known, known_spreads, moments), REGION)
    return _sizes(wrong, spreads, moments) <= limit


def overall(made: Sequence[Prediction], part: int | None = None) -> float:
    """Identified over nominal error: the geometric mean over states and horizons."""
    return geometric_mean(np.array([prediction.ratio(part) for prediction in made]))


def ratio(wrong: Array, reference: Array) -> float:
    """Root mean squares of errors (w, n) over those of a reference (v, n): the geometric mean over states."""
    both = (np.clip(_rmse(each), SMALLEST, LARGEST) for each in (wrong, reference))
    return geometric_mean(np.clip(np.divide(*both), 1 / MOST_RATIO, MOST_RATIO))


def geometric_mean(values: Array) -> float:
    """That of positive numbers."""
    return float(np.exp(np.mean(np.log(values))))


def _before(seconds: float) -> float:
    """The horizon before this one."""
    return max((each for each in HORIZONS if each < seconds), default=0.0)


def _rmse(wrong: Array) -> Array:
    """Root mean squares (n,) of errors (w, n)."""
    return np.sqrt(np.mean(wrong**2, axis=0)) if len(wrong) else np.zeros(wrong.shape[1])


def _sizes(wrong: Array, spreads: Array, moments: Array) -> Array:
    """Squared sizes (w,) of errors (w, n) in terms of spreads (w, n, n) and of common moments (n, n)."""
    scale = np.sqrt(np.diag(moments)) + np.finfo(float).tiny
    of_each = (spreads + COMMON * moments) / np.outer(scale, scale)
    scaled = wrong / scale
    return np.einsum("wi,wij,wj->w", scaled, np.linalg.pinv(of_each, hermitian=True), scaled)
