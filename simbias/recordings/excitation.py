"""Excitation: the input trajectories most informative about a model's parameters, within limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from simbias.core import Nominal
from simbias.core.errors import ConfigError
from simbias.core.parameters import values_at
from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import Identified
from simbias.learning.identification.posterior import Posterior
from simbias.learning.identification.problem import Information
from simbias.learning.prediction_errors import ErrorDistribution
from simbias.simulation.open_loop import PredictionModel, Windows, predict
from simbias.trial.study import Study

MODELS = 16  # the most probable one and draws, on which a trajectory must keep the limits
FURTHER = 200  # held-out draws for judging the limits
JUDGED = 4  # of the models, at which information is computed if nothing has been learned
HARMONICS = 20  # maximum number in each input's Fourier series
FASTEST = 5.0  # Hz
RAMP = 0.25  # s, in which inputs rise from zero and return to it
SCALES = 0.75 ** np.arange(12)  # candidate scales of inputs, until all limits are kept
FEWEST = 20  # frames of inputs: fewer are too few for rise, motion and fall
RELATIVE_NOISE = 0.005  # of a state's range, without recordings
REFERENCES, REFERENCE = 5, 5.0  # random trajectories for estimating states' ranges; s of each
RANDOM, SEED = 0.6, 0  # share of random trajectories; the others vary the best
LIMITS = "hardware.safety", "no inputs were found that keep these limits and the task's failure criteria"
CRITERIA = (
    "task",
    "no inputs were found that avoid its failures: a robot that falls needs a controller",
)


@dataclass(frozen=True, eq=False)
class Excitation:
    """Inputs, and their expected information."""

    rollout: Rollout  # predicted by the most probable model
    deviations: Array  # (p,) of the expected posterior, in prior deviations
    information: float  # nats gained: decrease of the posterior's log volume
    largest: Array  # (n,) magnitudes of states, over all models that keep the limits


class Designer:
    """Rates input trajectories by the expected posterior given recordings of them (D-optimal design).

    Parameters
    ----------
    study
        Its task's failure criteria and `hardware.safety` are the limits; its identification is the learner.
    model
        The current knowledge: the nominal model, or an identified one.
    noise
        Standard deviations (n,) of measured states, for a model without known errors. By default 0.5% of each
        state's range under random inputs within the limits (the median over several).

    Raises
    ------
    ConfigError
        If an input has no limit.
    """

    def __init__(self, study: Study, model: Nominal, noise: Array | None = None) -> None:
        posterior = study.identification
        assert isinstance(posterior, Posterior)
        self._study, self._posterior = study, posterior
        self.nominal = posterior.prior(study.nominal)
        rng = np.random.default_rng(SEED)
        known = model if isinstance(model, Identified) else Identified.of_prior(self.nominal)
        self._known, self._errors = known, known.errors
        z = np.array([known.mode, *(known.draw_coordinates(rng) for _ in range(MODELS - 1))])
        self._models = self._models_at(z)
        # Combined with the posterior at the mode, any other draw would seem to determine everything.
        judged_at = z[: 1 if known is model else JUDGED]
        self._informations = [Information(self.nominal, each) for each in judged_at]
        self._precision = np.linalg.inv(known.covariance)
        self.before = np.sqrt(np.diag(known.covariance))  # (p,)
        self._bounds = study.conditions.safety.bounds(study.task)
        for each, limit in zip(study.task.inputs, self._bounds.inputs.tolist(), strict=True):
            if not np.isfinite(limit):
                raise ConfigError("hardware.safety.inputs", f"{each.name} has no limit; set one here")
        self.noise = self._usual_noise() if noise is None else noise

    @threadpool_limits.wrap(limits=1, user_api="blas")  # small matrices, as in `assess`
    def design(
        self,
        seconds: float,
        trajectories: int,
        rng: np.random.Generator,
        progress: Callable[[str], None] = lambda words: None,
    ) -> Excitation:
        """The best of a number of trajectories with a duration in s.

        Raises
        ------
        ConfigError
            If none keeps the limits, or they are shorter than a window or FEWEST frames.
        """
        window, task = self._posterior.window, self._study.task
        if task.frames(seconds) < FEWEST:
            text = f"{task.time_step:g} s is too long for inputs of {seconds:g} s"
            raise ConfigError("task.time_step", f"{text}, which need at least {FEWEST} frames")
        if task.frames(seconds) < task.frames(window):
            raise ConfigError("identification.window", f"{window:g} s is longer than inputs of {seconds:g} s")
        best: tuple[float, Array, Excitation] | None = None
        for index in range(trajectories):
            progress(f"trajectory {index + 1} of {trajectories}")
            if best is None or index < RANDOM * trajectories:
                c = self._random(rng)
            else:
                shape = best[1].shape
                c = best[1] * (1.0 + 0.3 * rng.standard_normal(shape)) + 0.1 * rng.standard_normal(shape)
            found = self.rated(self._inputs(c, seconds))
            if found is not None and (best is None or found.information > best[0]):
                best = found.information, c, found
        if best is None:
            raise ConfigError(*(LIMITS if self._study.conditions.safety.limits else CRITERIA))
        return best[2]

    def rated(self, inputs: Array) -> Excitation | None:
        """Rate inputs (T, m), scaled down until all models keep the limits; None if they never do."""
        rollouts, kept = self._scaled(inputs)
        return self._judged(rollouts) if kept else None

    def beyond(self, inputs: Array) -> float:
        """The share of held-out draws that exceed the limits under inputs (T, m)."""
        (rng,) = np.random.default_rng(SEED).spawn(1)
        drawn = self._models_at([self._known.draw_coordinates(rng) for _ in range(FURTHER)])
        return float(np.mean([not self._allowed(each) for each in self._simulated(inputs, drawn)]))

    def _models_at(self, coordinates: Sequence[Array] | Array) -> list[Nominal]:
        """The nominal models with parameters at each of these coordinates (p,)."""
        parameters = self.nominal.parameters
        return [self.nominal.with_parameters(values_at(parameters, z)) for z in coordinates]

    def _scaled(self, inputs: Array) -> tuple[list[Rollout], bool]:
        """Rollouts of all models under inputs (T, m), scaled down until limits are kept; success flag."""
        for scale in SCALES:
            rollouts = self._simulated(np.clip(scale * inputs, *self._bounds.input_bounds), self._models)
            if all(self._allowed(rollout) for rollout in rollouts):
                return rollouts, True
        return rollouts, False

    def _usual_noise(self) -> Array:
        """Standard deviations (n,) of measured states: a share of each range in random trajectories."""
        rng = np.random.default_rng(SEED)
        moved = [self._scaled(self._inputs(self._random(rng), REFERENCE))[0] for _ in range(REFERENCES)]
        return RELATIVE_NOISE * np.median([np.ptp(each[0].states, axis=0) for each in moved], axis=0)

    def _random(self, rng: np.random.Generator) -> Array:
        """Coefficients (m, 2, h) of random inputs with random strengths, up to a random frequency."""
        shape = (len(self._study.task.inputs), 2, HARMONICS)
        fastest = rng.uniform(0.1, 1.0)
        c = rng.standard_normal(shape) * (np.arange(HARMONICS) < fastest * HARMONICS)
        c *= np.exp(rng.standard_normal((shape[0], 1, 1)))
        return c

    def _inputs(self, c: Array, seconds: float) -> Array:
        """Inputs (T, m) from Fourier coefficients (m, 2, h), as large as the limits allow."""
        task = self._study.task
        t = task.time_step * np.arange(task.frames(seconds))
        h = c.shape[2]
        phases = 2 * np.pi * np.outer(t, np.linspace(1 / seconds, FASTEST, h))
        u = np.sin(phases) @ c[:, 0].T + np.cos(phases) @ c[:, 1].T
        ramp = np.clip(np.minimum(t, t[-1] - t) / RAMP, 0.0, 1.0)[:, None]
        u *= ramp
        lower, upper = self._bounds.input_bounds
        middle, limit = (lower + upper) / 2, (upper - lower) / 2
        return ramp * middle + u * limit / np.maximum(np.abs(u).max(axis=0), 1e-12)

    def _simulated(self, inputs: Array, models: Sequence[Nominal]) -> list[Rollout]:
        """The rollout of each model under inputs (T, m) from the task's mean start."""
        start = self._study.task.start_mean
        states = np.broadcast_to(start, (len(inputs) + 1, len(start)))
        windows = Windows.of([Rollout(states, inputs)], len(inputs), 1)
        made = predict([PredictionModel(model) for model in models], windows)[:, 0]
        return [Rollout(np.vstack([start, each]), inputs) for each in made]

    def _allowed(self, rollout: Rollout) -> bool:
        """Whether no criterion fails and no limit is exceeded."""
        task, bounds = self._study.task, self._bounds
        return bool(
            (task.violated(rollout.states) < 0).all()
            and (np.abs(rollout.states) <= bounds.states).all()
            and (np.abs(np.diff(rollout.inputs, axis=0)) <= bounds.input_rates * task.time_step).all()
        )

    def _judged(self, rollouts: Sequence[Rollout]) -> Excitation:
        """Expected deviations and information of a trajectory: means over several models."""
        errors = self._errors or self._of_noise(rollouts[0])
        covariances, gains = [], []
        for information, rollout in zip(self._informations, rollouts, strict=False):
            windows = self._posterior.cut([rollout])  # without noise
            precision = self._precision + information.of(windows, errors)
            covariances.append(np.linalg.inv(precision))
            gains.append(0.5 * (np.linalg.slogdet(precision)[1] - np.linalg.slogdet(self._precision)[1]))
        deviations = np.sqrt(np.mean([np.diag(each) for each in covariances], axis=0))
        largest = np.max([np.abs(each.states).max(axis=0) for each in rollouts], axis=0)
        return Excitation(rollouts[0], deviations, float(np.mean(gains)), largest)

    def _of_noise(self, rollout: Rollout) -> ErrorDistribution:
        """The distribution of the true model's prediction errors on a noisy recording."""
        rng = np.random.default_rng(SEED)
        noisy = rollout.states + self.noise * rng.standard_normal(rollout.states.shape)
        recorded = Rollout(noisy, rollout.inputs, measured=noisy, sensed=True)
        windows = self._posterior.windows([recorded])
        errors = predict([PredictionModel(self._models[0])], windows)[0] - windows.means
        return ErrorDistribution.of(errors, windows)
