"""Posterior of the nominal model's parameters given experiments: the mode and a normal around it."""

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

ROBUST_FREEDOM = 0.1  # nu / d of the first rounds, in which outliers have next to no weight
WIDEST = 2.0  # deviations of the prior by which errors scatter the mode, beyond which they tell nothing
AS_DECLARED = -5.0  # coordinate at which a half-normal parameter is what is declared, to 1e-7 of its spread
SMOOTHING = 0.05  # s, at least, of recordings; in trials it is as declared
TOLERANCE = 0.05  # of the mode's convergence, in standard deviations of the posterior


class Posterior(Identification):
    """Maximum a posteriori estimate from predictions over windows of recorded experiments.

    In the coordinates of the parameters' priors, the mode minimises

        |z|^2 + independent_share * sum over windows of (nu + d) ln(1 + |whitened errors|^2 / nu).

    The d errors of a window are whitened by their covariance over all windows, estimated in turn with the
    mode (`simbias.learning.prediction_errors`), so sensor noise, process noise and model errors need not be
    told apart. `independent_share` discounts windows whose errors correlate with those of the window before.

    Where no robot has the mode's parameters, the nearest that one may have take their place, and draws that
    none has are drawn again (`Nominal.slack`).

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
        Number of draws from the prior, its median the first; the search begins at the likeliest. With central
        differences the declared values are one more, which are at the end of a half-normal prior.
    rounds
        Largest number of rounds in which covariance and mode are estimated in turn, once with nearly no
        weight for outliers, and once more with the t distribution of the errors.
    evaluations
        Largest number of steps of the search for the mode in a round.
    known
        An earlier posterior, as of recordings, in place of the declared prior.
    motors, sensors
        How uncertain those of inputs and states are, by name (`simbias.learning.identification.rig`).
    each
        Names of the model's parameters of which each recording has its own, as a load that is put on; the
        others are shared.
    noise
        Variances of what is measured, by the names and kinds of states. Prediction errors are never taken to
        be smaller. Without it, a model that is exact in the air makes outliers of all collisions. With it, or
        by central differences, the posterior is nowhere far wider than the prior: where the data tell nothing
        of a direction, its deviation is the prior's.
    longer_windows
        Further durations in s of predictions, as what differs little in a short while may differ much in a
        long one. Each window counts alike; durations that no experiment has do not count.
    smoothing
        Each prediction of measured states begins at a smoothed one, from those at most so many s before and
        after (`simbias.learning.noise.smoothed`). Without it, noise of velocities is mistaken for damping
        where friction is dry. `identify`, `excite` and `--recover` take 0.05 s at least. 0, of published
        trials: predictions begin at states as they were measured.
    differences
        That the covariance is computed from. Under strong motion only central ones tell what experiments do
        not determine; `identify`, `excite` and `--recover` always take these. Forward ones are quicker, may
        make the posterior far wider than the prior, and are those of published trials.

    Raises
    ------
    ValueError
        If the task has no such motor or sensor; in `fit`, if the model has no such parameter, or `known` is
        not of its parameters.
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
        self._known = known
        self._starts = starts
        self._rounds = rounds
        self._evaluations = evaluations
        self._longer = longer_windows or []
        self._smoothing = smoothing
        self._differences = differences
        self._noise = np.sqrt(Noise(task, noise).sensor_variance[: len(task.without_targets.states)])

    def _set_window(self, window: float) -> None:
        """Round its duration in s to a whole number of chunks."""
        frames = window / self._task.time_step
        self._chunk = max(1, round(frames / self._chunks))
        self._window = max(1, round(frames / self._chunk)) * self._chunk

    @property
    def window(self) -> float:
        """Duration of a prediction in s."""
        return self._window * self._task.time_step

    def with_window(self, window: float) -> Posterior:
        """A copy whose predictions last `window` s, longer ones in proportion."""
        other = copy(self)
        other._set_window(window)
        other._longer = [each * window / self.window for each in self._longer]
        return other

    def of_recordings(self) -> Posterior:
        """A copy with central differences, whose predictions begin at smoothed states."""
        other = copy(self)
        options = options_of_recordings({"smoothing": self._smoothing})
        other._smoothing, other._differences = options["smoothing"], options["differences"]
        return other

    @property
    def begins_with_known(self) -> bool:
        """Whether an earlier posterior is its prior."""
        return self._known is not None

    def with_known(self, known: Known) -> Posterior:
        """A copy that begins with an earlier posterior."""
        other = copy(self)
        other._known = known
        return other

    def windows(self, rollouts: Sequence[Rollout], recordings: Sequence[str] = ()) -> Windows:
        """Experiments, cut as predictions are compared with them."""
        windows = self.cut(rollouts)
        if frames := round(self._smoothing / self._task.time_step):
            made = zip(rollouts, smoothed(rollouts, frames), strict=True)
            smooth = [replace(rollout, states=states) for rollout, states in made]
            windows = replace(windows, smoothed=self.cut(smooth).states)
        if not recordings:
            return windows
        order = list(dict.fromkeys(recordings))
        return replace(windows, recordings=np.array([order.index(each) for each in recordings]))

    def cut(self, rollouts: Sequence[Rollout]) -> Windows:
        """Windows of the declared duration, whose predictions begin at states as they are."""
        return Windows.of(rollouts, self._window, self._chunk, self._noise)

    def fit(self, nominal: Nominal, rollouts: Sequence[Rollout], recordings: Sequence[str] = ()) -> Nominal:
        """The model at the mode, which draws from the posterior.

        Without a whole window it is the model itself, whose motors and sensors are uncertain as declared, or
        the one that is known. Rollouts that are pieces of a recording share what that has of its own;
        `recordings` are names of these, by default each rollout is one.
        """
        if self._known is None:
            return self._fit(self.prior(nominal), rollouts, recordings)
        prior = KnownPrior(self.prior(nominal), self._known)
        fitted = self._fit(prior, rollouts, recordings)
        return prior.posterior(fitted if isinstance(fitted, Identified) else None)

    def prior(self, nominal: Nominal) -> Nominal:
        """The nominal model, with the parameters of motors and sensors if any are uncertain."""
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
                precision = problem.precision(z)
                if (z - before) @ precision @ (z - before) < TOLERANCE**2 * len(z):
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
    """Options of a posterior with those that recordings are learned from with."""
    smoothing = max(options.get("smoothing", 0.0), SMOOTHING)
    return {**options, "smoothing": smoothing, "differences": "central"}


def _no_wider(spread: Array) -> Array:
    """A square root (p, p) of the covariance, that of the prior in directions in which it is far wider."""
    directions, deviations, _ = np.linalg.svd(spread)
    if deviations.max() <= WIDEST:
        return spread
    return directions * np.where(deviations > WIDEST, 1.0, deviations)
