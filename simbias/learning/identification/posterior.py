"""Posterior of the nominal model's parameters given experiments: the mode and a normal around it."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.optimize import least_squares

from simbias.core import Identification, Nominal, Task
from simbias.core.parameters import values_at
from simbias.core.ranges import Count, Seconds
from simbias.core.records import Array, Rollout
from simbias.learning.identification.directions import undetermined
from simbias.learning.identification.identified import Identified, Known, KnownPrior
from simbias.learning.identification.rig import Motor, Rig, Sensor
from simbias.learning.measurement_noise import Linearisation
from simbias.learning.prediction_errors import FREEDOM, ErrorDistribution
from simbias.simulation.open_loop import PredictionModel, Windows, predict

STEP = 1e-4  # of finite differences: of a coordinate, or of the standard deviation of a state
LEAST_DEVIATION = 1e-9  # added to the standard deviation of a state
ROBUST_FREEDOM = 0.1  # nu / d of the first rounds, in which outliers have next to no weight
SPREAD_ROUNDS = 2  # of estimating the errors' covariance, with the part that fitted parameters removed
TOLERANCE = 0.05  # of the mode's convergence, in standard deviations of the posterior


class Posterior(Identification):
    """Maximum a posteriori estimate from predictions over windows of recorded experiments.

    In the coordinates of the parameters' priors, the mode minimises

        |z|^2 + independent_share * sum over windows of (nu + d) ln(1 + |whitened errors|^2 / nu).

    The d errors of a window are whitened by their covariance over all windows, estimated in turn with the
    mode (`simbias.learning.prediction_errors`), so sensor noise, process noise and model errors need not be
    told apart. `independent_share` discounts windows whose errors correlate with those of the window before.

    The posterior is normal around the mode, with the covariance by which such errors scatter the mode. With
    few windows, the covariance that measurement noise gives to errors is computed from the linearised model
    (`simbias.learning.measurement_noise`).

    Parameters
    ----------
    window
        Duration of a prediction in s.
    chunks
        Number of parts of a window whose means are compared.
    starts
        Number of draws from the prior, its median the first; the search begins at the likeliest.
    rounds
        Largest number of rounds in which covariance and mode are estimated in turn, once with nearly no
        weight for outliers, and once more with the t distribution of the errors.
    evaluations
        Largest number of steps of the search for the mode in a round.
    known
        An earlier posterior, as of recordings, in place of the declared prior.
    motors, sensors
        How uncertain those of inputs and states are, by name (`simbias.learning.identification.rig`).

    Raises
    ------
    ValueError
        If `known` is not of the model's parameters, or the task has no such motor or sensor (`fit`).
    """

    def __init__(
        self,
        task: Task,
        window: Seconds = 0.1,
        chunks: Count = 10,
        starts: Count = 32,
        rounds: Count = 4,
        evaluations: Count = 12,
        known: Known | None = None,
        motors: dict[str, Motor] | None = None,
        sensors: dict[str, Sensor] | None = None,
    ) -> None:
        self._task, self._motors, self._sensors = task, motors or {}, sensors or {}
        self._time_step = task.time_step
        self._chunks = chunks
        self._set_window(window)
        self._known = known
        self._starts = starts
        self._rounds = rounds
        self._evaluations = evaluations

    def _set_window(self, window: float) -> None:
        """Round its duration in s to a whole number of chunks."""
        frames = window / self._time_step
        self._chunk = max(1, round(frames / self._chunks))
        self._window = max(1, round(frames / self._chunk)) * self._chunk

    @property
    def window(self) -> float:
        """Duration of a prediction in s."""
        return self._window * self._time_step

    def with_window(self, window: float) -> Posterior:
        """A copy whose predictions last `window` s."""
        other = copy(self)
        other._set_window(window)
        return other

    def windows(self, rollouts: Sequence[Rollout]) -> Windows:
        """Experiments, cut as predictions are compared with them."""
        return Windows.of(rollouts, self._window, self._chunk)

    def fit(self, nominal: Nominal, rollouts: Sequence[Rollout]) -> Nominal:
        """The model at the mode, which draws from the posterior.

        Without a whole window it is the model itself, whose motors and sensors are uncertain as declared, or
        the one that is known.
        """
        if self._known is None:
            return self._fit(self.prior(nominal), rollouts)
        prior = KnownPrior(self.prior(nominal), self._known)
        fitted = self._fit(prior, rollouts)
        return prior.posterior(fitted if isinstance(fitted, Identified) else None)

    def prior(self, nominal: Nominal) -> Nominal:
        """The nominal model, with the parameters of motors and sensors if any are uncertain."""
        if not self._motors and not self._sensors:
            return nominal
        return Rig(self._task, nominal, self._motors, self._sensors)

    def _fit(self, nominal: Nominal, rollouts: Sequence[Rollout]) -> Nominal:
        """The posterior, with the declared prior."""
        windows = self.windows(rollouts) if rollouts else None
        if not nominal.parameters or not windows:
            return nominal
        z = self._start(nominal, windows)
        for freedom in (ROBUST_FREEDOM, FREEDOM):
            for _ in range(self._rounds):
                problem = Problem.at(nominal, windows, z, freedom)
                before, z = z, problem.mode(z, self._evaluations)
                precision = problem.precision(z)
                if (z - before) @ precision @ (z - before) < TOLERANCE**2 * len(z):
                    break
        fitted = Identified(nominal, z, problem.spread(z), {}, problem.errors)
        share = problem.errors.independent_share
        fitted.diagnostics = {
            "windows": len(windows),
            "share": share,
            "undetermined": len(undetermined(fitted)),
        }
        return fitted

    def _start(self, nominal: Nominal, windows: Windows) -> Array:
        """The likeliest coordinates (p,) among the prior's median and draws from it."""
        z = np.random.default_rng(0).standard_normal((self._starts, len(nominal.parameters)))
        z[0] = 0.0
        errors = predict([_model(nominal, each) for each in z], windows) - windows.means
        fits = [
            ErrorDistribution.of(each, windows, ROBUST_FREEDOM).log_likelihoods(each).sum() for each in errors
        ]
        return z[np.argmax(fits - 0.5 * np.sum(z**2, axis=1))]


def _model(nominal: Nominal, z: Array, offset: Array | None = None) -> PredictionModel:
    """The model with its parameters at coordinates z (p,)."""
    return PredictionModel(nominal.with_parameters(values_at(nominal.parameters, z)), offset=offset)


class Problem:
    """Nonlinear least squares for the mode, with the errors' covariance given."""

    def __init__(self, nominal: Nominal, windows: Windows, errors: ErrorDistribution) -> None:
        self._nominal = nominal
        self._windows = windows
        self._observed = windows.means
        self.errors = errors
        self._last: tuple[bytes, Array, Array] | None = None

    @staticmethod
    def at(nominal: Nominal, windows: Windows, z: Array, freedom: float) -> Problem:
        """The problem with the errors' covariance estimated at coordinates z (p,)."""
        problem = Problem(nominal, windows, ErrorDistribution(np.empty((0, 0))))
        problem.errors = ErrorDistribution.of(problem._errors(z[None])[0], windows, freedom)
        return problem

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

    def information(self, z: Array) -> Array:
        """Fisher information (p, p) about coordinates that these windows would hold if z were the truth."""
        each = self._errors(z + STEP * np.eye(len(z) + 1, len(z), -1))
        J = self.errors.whiten(each[1:] - each[0]).reshape(len(z), -1) / STEP
        return self.errors.independent_share * J @ J.T

    def precision(self, z: Array) -> Array:
        """Curvature (p, p) of the negative logarithm of the density at z."""
        J = self._at(z)[1]
        return J.T @ J

    def spread(self, z: Array) -> Array:
        """A square root (p, p) of the covariance of the mode z: H^-1 (I + G) H^-1, with the precision H.

        G is the covariance of the log-density's gradient under the errors' estimated covariance; H has the
        one that weights the errors (V. P. Godambe, Annals of Mathematical Statistics 31, 1960).
        """
        p, windows = len(z), self._windows
        steps = STEP * (np.std(windows.states, axis=0) + LEAST_DEVIATION)
        models = [_model(self._nominal, each) for each in z + STEP * np.eye(p + 1, p, -1)]
        models += [_model(self._nominal, z, offset) for offset in np.diag(steps)]
        each = predict(models, windows)
        by_start = np.moveaxis((each[p + 1 :] - each[0]) / steps[:, None, None, None], 0, -1)
        errors = each[0] - self._observed
        white = self.errors.whiten(errors)
        J = (self.errors.whiten(each[1 : p + 1] - self._observed) - white) / STEP  # (p, w, d)
        by_parameters = np.moveaxis((each[1 : p + 1] - each[0]) / STEP, 0, -1)
        spread = solve_triangular(qr(self._at(z)[1], mode="economic")[1], np.eye(p))
        H, weights = spread @ spread.T, self.errors.independent_share * self.errors.weights(white)
        for _ in range(SPREAD_ROUNDS):
            linearisation = Linearisation.of(by_start, by_parameters @ spread)
            ratio = np.linalg.solve(
                self.errors.factor, ErrorDistribution.of(errors, windows, FREEDOM, linearisation).factor
            )
            across = (np.sqrt(weights)[:, None] * (J @ ratio)).reshape(p, -1)
            scattered = H @ np.hstack([np.eye(p), across])
            spread = qr(scattered.T, mode="economic")[1].T
        return spread

    def log_densities(self, z: Array) -> Array:
        """Posterior log-density (k,) at coordinates z (k, p), up to a constant."""
        white = self.errors.whiten(self._errors(z))
        return -0.5 * (
            np.sum(z**2, axis=1) + self.errors.independent_share * self.errors.losses(white).sum(axis=1)
        )

    def _errors(self, z: Array) -> Array:
        """Errors (k, w, J, n) with the parameters at coordinates z (k, p)."""
        return predict([_model(self._nominal, each) for each in z], self._windows) - self._observed

    def _at(self, z: Array) -> tuple[Array, Array]:
        """Residuals (w d + p,), the prior's last, and their derivatives by z (p,)."""
        if self._last is None or self._last[0] != z.tobytes():
            p = len(z)
            white = self.errors.whiten(self._errors(z + STEP * np.eye(p + 1, p, -1)))
            J = (white[1:] - white[0]) / STEP
            weights = self.errors.independent_share * self.errors.weights(white[0])
            losses = self.errors.independent_share * self.errors.losses(white[0])
            size = np.sum(white[0] ** 2, axis=1)
            ratio = np.divide(losses, size, out=weights.copy(), where=size > 0)  # tends to the weights at 0
            scale = np.sqrt(ratio)  # so that squares sum to the loss
            slope = weights / scale
            r, J = scale[:, None] * white[0], slope[:, None] * J
            residuals, derivatives = np.append(r.ravel(), z), np.concatenate([J.reshape(p, -1).T, np.eye(p)])
            self._last = z.tobytes(), residuals, derivatives
        return self._last[1], self._last[2]
