"""Posterior of the nominal model's parameters given experiments: a normal around the mode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np

from simbias.core import Identification, Nominal, Task
from simbias.core.ranges import Count, Lag, Seconds
from simbias.core.records import Array, Rollout
from simbias.learning.identification.directions import undetermined
from simbias.learning.identification.identified import Identified, Known, KnownPrior
from simbias.learning.identification.possible import nearest_possible
from simbias.learning.identification.problem import Differences, Problem, WindowErrors
from simbias.learning.identification.rig import Motor, Rig, Sensor, check_signals
from simbias.learning.noise import smoothed
from simbias.learning.prediction_errors import FREEDOM, ErrorDistribution
from simbias.simulation.noise import QUIET, Noise, Variances
from simbias.simulation.open_loop import Windows

ROBUST_FREEDOM = 0.1  # nu / d in the first rounds, in which outliers have almost no weight
WIDEST = 2.0  # prior deviations: a direction in which errors scatter the mode more is uninformed
AS_DECLARED = -5.0  # coordinate at which a half-normal parameter is as declared, to 1e-7 of its spread
SMOOTHING = 0.05  # s, the minimum for recordings; in trials it is as declared
TOLERANCE = 0.05  # of the mode's convergence, in standard deviations of the posterior


class Posterior(Identification):
    """Maximum a posteriori estimate from window predictions of recorded experiments.

    In the coordinates of the parameters' priors, the mode minimises

        |z|^2 + independent_share * sum over windows of (nu + d) ln(1 + |whitened errors|^2 / nu).

    The d errors of a window are whitened by their covariance over all windows, which is estimated alternately
    with the mode (`simbias.learning.prediction_errors`). Sensor noise, process noise and model errors
    therefore need not be distinguished. `independent_share` discounts windows whose errors correlate with
    those of the previous window.

    If the mode's parameters are physically impossible, the nearest possible ones replace them; impossible
    draws are redrawn (`Nominal.slack`).

    The posterior is normal around the mode, with the covariance of the mode under such errors. With few
    windows, the covariance of errors due to measurement noise is computed from the linearised model
    (`simbias.learning.measurement_noise`).

    Parameters
    ----------
    window
        Duration of a prediction in s.
    chunks
        Number of parts of a window whose means are compared.
    starts
        Number of draws from the prior, the first of them its median; the search begins at the likeliest. With
        central differences, the declared values, which are at the end of a half-normal prior, are one more
        start.
    rounds
        Maximum number of rounds that alternate between estimating covariance and mode, first with almost no
        weight for outliers, then again with the t distribution of the errors. 4, as in the published trials,
        may not suffice for many parameters.
    evaluations
        Maximum number of steps of the search for the mode in each round.
    known
        An earlier posterior, for example from recordings, instead of the declared prior.
    motors, sensors
        The uncertainty of the motors of inputs and the sensors of states, by name
        (`simbias.learning.identification.rig`).
    each
        Names of the model's parameters that differ between recordings, such as a payload; the others are
        shared.
    noise
        Measurement noise variances, by the names and kinds of states; added to those of prediction errors.
        Without it, a model that is exact in flight makes all collisions outliers. With it, or with central
        differences, the posterior is nowhere far wider than the prior: where the data do not inform a
        direction, its deviation is the prior's.
    longer_windows
        Further durations in s of predictions, since small short-term differences may grow large in the long
        term. Every window counts equally; durations longer than all experiments are ignored.
    smoothing
        Each prediction of measured states begins at a state smoothed over at most this many s before and
        after (`simbias.learning.noise.smoothed`). Without smoothing, noise in velocities makes dry friction
        look like damping. `identify`, `excite` and `--recover` use at least 0.05 s. 0, as in the published
        trials: predictions begin at the measured states.
    differences
        Finite differences for the covariance. Under strong motion, only central ones reveal what experiments
        do not determine; `identify`, `excite` and `--recover` always use these. Forward ones, as in the
        published trials, are faster, but may make the posterior far wider than the prior.

    Raises
    ------
    ValueError
        If the task has no such motor or sensor; in `fit`, if the model has no such parameter, or `known` has
        other parameters.
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
        each: list[str] | None = None,
        longer_windows: list[Seconds] | None = None,
        noise: Variances = QUIET,
        smoothing: Lag = 0.0,
        differences: Differences = "forward",
    ) -> None:
        self._task, self._motors, self._sensors, self._each = task, motors or {}, sensors or {}, each or []
        check_signals(task, self._motors, self._sensors)
        self._chunks = chunks
        self._set_window(window)
        self.known = known  # the earlier posterior that is its prior
        self._starts = starts
        self._rounds = rounds
        self._evaluations = evaluations
        self._longer = longer_windows or []
        self._smoothing = smoothing
        self._differences = differences
        self._noise = np.sqrt(Noise(task, noise).sensor_variance[: len(task.without_targets.states)])

    def _set_window(self, window: float) -> None:
        """Set the duration of a prediction in s, rounded to a whole number of chunks."""
        frames = window / self._task.time_step
        self._chunk = max(1, round(frames / self._chunks))
        self._window = max(1, round(frames / self._chunk)) * self._chunk

    @property
    def window(self) -> float:
        """Duration of a prediction in s."""
        return self._window * self._task.time_step

    def with_window(self, window: float) -> Posterior:
        """A copy whose predictions last `window` s; longer windows are scaled in proportion."""
        other = copy(self)
        other._set_window(window)
        other._longer = [each * window / self.window for each in self._longer]
        return other

    def of_recordings(self) -> Posterior:
        """A copy for recordings: with central differences, and predictions that begin at smoothed states."""
        other = copy(self)
        options = options_of_recordings({"smoothing": self._smoothing})
        other._smoothing, other._differences = options["smoothing"], options["differences"]
        return other

    def with_known(self, known: Known | None) -> Posterior:
        """A copy that begins with an earlier posterior, or with the declared prior."""
        other = copy(self)
        other.known = known
        return other

    def windows(self, rollouts: Sequence[Rollout], recordings: Sequence[str] = ()) -> Windows:
        """Experiments, cut into windows for comparison with predictions."""
        windows = self.cut(rollouts)
        if frames := round(self._smoothing / self._task.time_step):
            window = self._window if self._differences == "central" else 0
            made = zip(rollouts, smoothed(rollouts, frames, window), strict=True)
            smooth = [replace(rollout, states=states) for rollout, states in made]
            windows = replace(windows, smoothed=self.cut(smooth).states)
        if not recordings:
            return windows
        order = list(dict.fromkeys(recordings))
        return replace(windows, recordings=np.array([order.index(each) for each in recordings]))

    def cut(self, rollouts: Sequence[Rollout]) -> Windows:
        """Windows of the declared duration; their predictions begin at states as recorded."""
        return Windows.of(rollouts, self._window, self._chunk, self._noise)

    def fit(self, nominal: Nominal, rollouts: Sequence[Rollout], recordings: Sequence[str] = ()) -> Nominal:
        """The model at the mode, whose draws come from the posterior.

        Without a whole window, the result is the model itself with motors and sensors as uncertain as
        declared, or the known model. Rollouts that are pieces of one recording share its specific parameters;
        `recordings` names the recording of each, by default one per rollout.
        """
        prior = self.known_prior(nominal)
        if prior is None:
            return self._fit(self.prior(nominal), rollouts, recordings)
        fitted = self._fit(prior, rollouts, recordings)
        return prior.posterior(fitted if isinstance(fitted, Identified) else None)

    def identified(
        self, nominal: Nominal, rollouts: Sequence[Rollout], recordings: Sequence[str] = ()
    ) -> Identified:
        """As `fit`; without a whole window, a declared prior is the posterior."""
        fitted = self.fit(nominal, rollouts, recordings)
        return fitted if isinstance(fitted, Identified) else Identified.of_prior(fitted)

    def known_prior(self, nominal: Nominal) -> KnownPrior | None:
        """The nominal model with the earlier posterior as its prior; None without one."""
        return None if self.known is None else KnownPrior(self.prior(nominal), self.known)

    def prior(self, nominal: Nominal) -> Nominal:
        """The nominal model, with the parameters of uncertain motors and sensors."""
        if not self._motors and not self._sensors and not self._each:
            return nominal
        return Rig(self._task, nominal, self._motors, self._sensors, self._each)

    def _fit(self, nominal: Nominal, rollouts: Sequence[Rollout], recordings: Sequence[str]) -> Nominal:
        """The posterior, with the declared prior."""
        windows = self.windows(rollouts, recordings) if rollouts else None
        if not nominal.parameters or not windows:
            return nominal
        longer = [self.with_window(each).windows(rollouts, recordings) for each in self._longer]
        compared = [windows, *(each for each in longer if len(each))]
        z = self._start(nominal, windows)
        for freedom in (ROBUST_FREEDOM, FREEDOM):
            for _ in range(self._rounds):
                problem = Problem(nominal, compared, z, freedom)
                before, z = z, problem.mode(z, self._evaluations)
                moved = (z - before) @ problem.precision(z) @ (z - before) / len(z)
                if moved < TOLERANCE**2:
                    break
        spread = problem.spread(z, self._differences)
        if self._noise.any() or self._differences == "central":
            spread = _no_wider(spread)
        z = nearest_possible(nominal, z, spread)
        fitted = Identified.of_recordings(nominal, z, spread, problem.places, problem.errors)
        fitted.diagnostics = {
            "windows": len(windows),
            "share": problem.errors.independent_share,
            "undetermined": len(undetermined(fitted)),
            "moved": float(np.sqrt(moved)),  # standard deviations, by the last round
        }
        return fitted

    def _start(self, nominal: Nominal, windows: Windows) -> Array:
        """The likeliest coordinates (p,) among the prior's median, draws from it and declared values."""
        problem = WindowErrors(nominal, windows)
        z = np.random.default_rng(0).standard_normal((self._starts, problem.size))
        z[0] = 0.0
        if self._differences == "central":
            half_normal = [parameter.prior == "half_normal" for parameter in nominal.parameters]
            z = np.vstack([z, np.zeros(problem.size)])
            z[-1, problem.places[:, half_normal]] = AS_DECLARED
        fits = [
            ErrorDistribution.of(each, windows, ROBUST_FREEDOM).log_likelihoods(each).sum()
            for each in problem.prediction_errors(z)
        ]
        return z[np.argmax(fits - 0.5 * np.sum(z**2, axis=1))]


def options_of_recordings(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a posterior, changed as required for learning from recordings."""
    smoothing = max(options.get("smoothing", 0.0), SMOOTHING)
    return {**options, "smoothing": smoothing, "differences": "central"}


def _no_wider(spread: Array) -> Array:
    """A square root (p, p) of the covariance, replaced by the prior's in directions that are far wider."""
    directions, deviations, _ = np.linalg.svd(spread)
    if deviations.max() <= WIDEST:
        return spread
    return directions * np.where(deviations > WIDEST, 1.0, deviations)
