"""The nominal model's parameters, given hardware experiments: the mode, and a normal around it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares

from simbias.config.numbers import Count, Seconds
from simbias.interfaces import Identification, Nominal, Task
from simbias.parameters import Estimate, values_at
from simbias.records import Array, Rollout
from simbias.simulation.errors import FREEDOM, Errors
from simbias.simulation.open_loop import Windows, World, predict

STEP = 1e-4  # of a coordinate, for derivatives by differences
ROBUST = 0.1  # nu / d at first: the mode is found whatever happens in some windows
TOLERANCE = 0.05  # in standard deviations of the posterior: a round that moves the mode by less is the last
QUANTILE = 1.6449  # 95% of a standard normal


class Posterior(Identification):
    """Errors of predictions over short windows, from recorded states under recorded inputs, are made small.

    In the coordinates of the parameters' priors, the mode minimises

        |z|^2 + share * sum over windows of (nu + d) ln(1 + |whitened errors|^2 / nu).

    The d errors of a window are whitened by their own covariance over all windows, which is estimated in turn
    with the mode (`simbias.simulation.errors`). So it need not be known where errors come from: noise of the
    sensors, also in the state that a window begins with, noise that acts on the robot, or what the model
    lacks. The share makes windows count less where successive ones err alike, as they do where the model
    lacks something: so the posterior is not surer than the data allows. Around the mode it is normal
    (Laplace's approximation).

    Parameters
    ----------
    window
        Duration of a prediction in s.
    chunks
        Means over so many parts of it are compared.
    starts
        So many draws from the prior, its median the first, are tried; the search begins at the likeliest.
    rounds
        At most so many times, covariance and mode are estimated in turn; first with outliers that count next
        to nothing, then with the distribution that errors have.
    evaluations
        Steps of the search for the mode in each of them, at most.
    """

    def __init__(
        self,
        task: Task,
        window: Seconds = 0.1,
        chunks: Count = 10,
        starts: Count = 32,
        rounds: Count = 4,
        evaluations: Count = 12,
    ) -> None:
        frames = window / task.time_step
        self._chunk = max(1, round(frames / chunks))
        self._window = max(1, round(frames / self._chunk)) * self._chunk
        self._starts = starts
        self._rounds = rounds
        self._evaluations = evaluations

    def fit(self, nominal: Nominal, rollouts: Sequence[Rollout]) -> Nominal:
        """The model at the mode, which draws from the posterior; without a whole window, the model itself."""
        windows = Windows.of(rollouts, self._window, self._chunk) if rollouts else None
        if not nominal.parameters or not windows:
            return nominal
        observed = windows.means
        z = self._start(nominal, windows, observed)
        for freedom in (ROBUST, FREEDOM):
            for _ in range(self._rounds):
                errors = Errors.of(_predicted(nominal, windows, z[None])[0] - observed, windows, freedom)
                problem = _Problem(nominal, windows, observed, errors)
                before, z = z, problem.mode(z, self._evaluations)
                precision = problem.precision(z)
                if (z - before) @ precision @ (z - before) < TOLERANCE**2 * len(z):
                    break
        return Identified(nominal, z, precision, {"windows": len(windows), "share": problem.errors.share})

    def _start(self, nominal: Nominal, windows: Windows, observed: Array) -> Array:
        """The likeliest coordinates (p,) among the prior's median and draws from it."""
        z = np.random.default_rng(0).standard_normal((self._starts, len(nominal.parameters)))
        z[0] = 0.0
        errors = _predicted(nominal, windows, z) - observed
        fits = [Errors.of(each, windows, ROBUST).log_likelihoods(each).sum() for each in errors]
        return z[np.argmax(fits - 0.5 * np.sum(z**2, axis=1))]


def _predicted(nominal: Nominal, windows: Windows, z: Array) -> Array:
    """Predictions (k, w, J, n) with the parameters at coordinates z (k, p)."""
    worlds = [World(nominal.with_parameters(values_at(nominal.parameters, each))) for each in z]
    return predict(worlds, windows)


class _Problem:
    """Nonlinear least squares for the mode, with the errors' covariance given."""

    def __init__(self, nominal: Nominal, windows: Windows, observed: Array, errors: Errors) -> None:
        self._nominal = nominal
        self._windows = windows
        self._observed = observed
        self.errors = errors
        self._last: tuple[bytes, Array, Array] | None = None

    def mode(self, z: Array, evaluations: int) -> Array:
        """The most probable coordinates, searched from z."""
        return least_squares(
            lambda at: self._at(at)[0],
            z,
            lambda at: self._at(at)[1],
            ftol=1e-5,
            xtol=1e-4,
            max_nfev=evaluations,
        ).x

    def precision(self, z: Array) -> Array:
        """Inverse covariance (p, p) of the posterior around the mode."""
        J = self._at(z)[1]
        return J.T @ J

    def _at(self, z: Array) -> tuple[Array, Array]:
        """Residuals, the prior's last, and their derivatives by z."""
        if self._last is None or self._last[0] != z.tobytes():
            p = len(z)
            errors = (
                _predicted(self._nominal, self._windows, z + STEP * np.eye(p + 1, p, -1)) - self._observed
            )
            white = self.errors.whiten(errors)
            J = (white[1:] - white[0]) / STEP
            size = np.sum(white[0] ** 2, axis=1) + 1e-300
            flatter = np.sqrt(
                self.errors.share * self.errors.losses(white[0]) / size
            )  # squares sum to the loss
            slope = self.errors.share * self.errors.weights(white[0]) / flatter
            r, J = flatter[:, None] * white[0], slope[:, None] * J
            residuals, derivatives = np.append(r.ravel(), z), np.concatenate([J.reshape(p, -1).T, np.eye(p)])
            self._last = z.tobytes(), residuals, derivatives
        return self._last[1], self._last[2]


@final
class Identified(Nominal):
    """A nominal model at the most probable parameters; it draws from their posterior."""

    def __init__(self, prior: Nominal, mode: Array, precision: Array, diagnostics: dict[str, float]) -> None:
        self._prior = prior
        self._mode = mode  # (p,) coordinates
        self._precision = np.linalg.cholesky(precision)  # its lower factor
        self._model = prior.with_parameters(values_at(prior.parameters, mode))
        self.kernel = self._model.kernel
        self.parameters = prior.parameters
        self.memory_size = self._model.memory_size
        self.diagnostics = diagnostics
        deviations = QUANTILE * np.sqrt(np.diag(np.linalg.inv(precision)))
        self.estimates = tuple(
            Estimate(p.name, p.unit, p.value, float(p.at(z)), float(p.at(z - d)), float(p.at(z + d)))
            for p, z, d in zip(prior.parameters, mode, deviations, strict=True)
        )

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n) of the most probable model."""
        return self._model.step(x, u)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        """x_next (..., n), and the memory (..., s), of the most probable model."""
        return self._model.advance(x, u, memory)

    def memories(self, states: Array, inputs: Array) -> Array:
        """Memory (k, s) in each frame of a record, from its start on."""
        return self._model.memories(states, inputs)

    def with_parameters(self, values: Array) -> Nominal:
        """The model with other values (k,) of its parameters."""
        return self._prior.with_parameters(values)

    def draw(self, rng: np.random.Generator) -> Nominal:
        """A model from the posterior."""
        e = solve_triangular(self._precision.T, rng.standard_normal(len(self._mode)), lower=False)
        return self._prior.with_parameters(values_at(self._prior.parameters, self._mode + e))
