"""The prediction of an experiment by simulation: one trajectory, and a band of others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simbias.core import FittedBias, Nominal
from simbias.core.records import Array, Rollout
from simbias.trial.study import Study

DRAWS, SEED = 40, 0
BAND = (0.05, 0.95)  # quantiles


@dataclass(frozen=True, eq=False)
class Prediction:
    """Simulated rollouts of an experiment with one policy."""

    expected: Rollout  # from its start, on the model that the search used
    draws: tuple[Rollout, ...]  # from other starts that the task draws, on models that may be right too

    @property
    def failures(self) -> list[str]:
        """The failures of those draws that failed."""
        return [draw.failure or "failed" for draw in self.draws if draw.failed_at is not None]

    def band(self, inputs: bool = False) -> tuple[Array, Array]:
        """Quantiles (T+1, n) of the draws' states, or (T, m) of their inputs; what has failed is in none."""
        series = [draw.inputs if inputs else draw.states for draw in self.draws]
        whole = np.full((len(series), max(map(len, series)), series[0].shape[1]), np.nan)
        for place, values in zip(whole, series, strict=True):
            place[: len(values)] = values
        low, high = np.nanquantile(whole, BAND, axis=0)
        return low, high

    def largest_change(self, time_step: float) -> Array:
        """The largest change (m,) of each input in a second, from one frame to the next, in any of them."""
        changes = [np.abs(np.diff(each.inputs, axis=0)) for each in (self.expected, *self.draws)]
        return np.max([change.max(axis=0, initial=0.0) for change in changes], axis=0) / time_step


def predict(
    study: Study,
    theta: Array,
    start: Array,
    bias: FittedBias | None = None,
    nominal: Nominal | None = None,
) -> Prediction:
    """Simulate an experiment with theta (p,) from a start (n,), without noise.

    Draws begin at random starts of the task, on models and biases as they may be, for all that is known.
    """
    model = study.model(bias, nominal)
    study = study.designed_on(model)
    rng = np.random.default_rng(SEED)
    draws = tuple(
        study.simulate(theta, model.bias.draw(rng), study.task.draw_start(rng), model.nominal.draw(rng))
        for _ in range(DRAWS)
    )
    return Prediction(study.simulate(theta, model.bias, start, model.nominal), draws)
