"""The prediction of an experiment by simulation: one trajectory, and a band from random draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simbias.core import FittedBias, Nominal
from simbias.core.records import Array, Rollout
from simbias.robots.none import NoNominal
from simbias.trial.study import Study

DRAWS, SEED = 40, 0
BAND = (0.05, 0.95)  # quantiles


@dataclass(frozen=True, eq=False)
class Prediction:
    """Simulated rollouts of an experiment with one policy."""

    expected: Rollout  # from its start, on the model that the search used
    draws: tuple[Rollout, ...]  # from random starts of the task, on drawn models
    drawn: str  # source of the draws, in words
    is_known: bool = True  # whether states can be predicted; not if there is neither a model nor data

    @property
    def failures(self) -> list[str]:
        """The failures of the draws that failed."""
        return [draw.failure or "failed" for draw in self.draws if draw.failed_at is not None]

    def band(self, inputs: bool = False) -> tuple[Array, Array]:
        """Quantiles (T+1, n) of the draws' states, or (T, m) of their inputs, up to their failures."""
        series = [draw.inputs if inputs else draw.states for draw in self.draws]
        whole = np.full((len(series), max(map(len, series)), series[0].shape[1]), np.nan)
        for place, values in zip(whole, series, strict=True):
            place[: len(values)] = values
        low, high = np.nanquantile(whole, BAND, axis=0)
        return low, high

    def largest_change(self, time_step: float) -> Array:
        """The largest rate of change (m,) of each input per second, between frames, in any rollout."""
        changes = [np.abs(np.diff(each.inputs, axis=0)) for each in (self.expected, *self.draws)]
        return np.max([change.max(axis=0, initial=0.0) for change in changes], axis=0) / time_step


def predict(
    study: Study, theta: Array, start: Array, bias: FittedBias | None = None, nominal: Nominal | None = None
) -> Prediction:
    """Simulate an experiment with theta (p,) from a start (n,), with neither noise nor a push.

    Draws begin at random starts of the task, on models and biases drawn from their posteriors, with the
    task's pushes and the noise that the hardware declares.
    """
    model, noise = study.model(bias, nominal), study.declared_noise
    study = study.designed_on(model)
    rng = np.random.default_rng(SEED)
    (noise_rng,) = rng.spawn(1)
    draws = tuple(
        study.simulate(
            theta,
            model.bias.draw(rng),
            study.task.draw_start(rng),
            model.nominal.draw(rng),
            None if noise.is_silent else noise.draw(noise_rng),
        )
        for _ in range(DRAWS)
    )
    noisy = noise.input_variance.any() or noise.sensor_variance.any()
    drawn = ["start", "model", *["noise"] * bool(noisy), *["pushes"] * bool(study.task.pushes)]
    words = f"{', '.join(drawn[:-1])} and {drawn[-1]}"
    expected = study.simulate(theta, model.bias, start, model.nominal)
    return Prediction(expected, draws, words, bias is not None or not isinstance(study.nominal, NoNominal))
