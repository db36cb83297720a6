"""Gaussian-process regression of the dynamics bias."""

from __future__ import annotations

import warnings

from simbias.core import Bias, FittedBias, SlowWarning, Task
from simbias.core.ranges import CountOrZero, NonNegative, Scale
from simbias.core.records import Transitions
from simbias.learning.bias.inducing import Inducing
from simbias.learning.bias.posterior import exact, sparse
from simbias.learning.covariance import Hyperparameters, hyperparameters
from simbias.learning.likelihood import HyperPriors, learn

# By sweeps/benchmarks/gp.py, batched on one thread: 11 us at N = 1000, growing faster than N^2 beyond.
SECONDS_PER_STEP = 11e-6 / 1000**2
STEPS_OF_A_SEARCH = 3.8e6  # of 1000 policies, some of which fall early
PATIENCE = 60.0  # s of a search that go without a warning: N = 1200


class GaussianProcess(Bias):
    """One Gaussian process for each state, all with the same hyper-parameters (Section IV-B, Table I).

    Parameters
    ----------
    length_scale
        Of the scaled inputs; one number, or one for each state and input.
    signal_variance, noise_variance
        alpha^2 and sigma^2 of Eq. 3, of residuals over their root mean square.
    d
        Weight of the variance in Eq. 7, which is that of all states together; 0: the mean as it is.
    input_scale
        One number for each state and input; by default 1 for states, its limit for an input.
    learning
        Learn the hyper-parameters, but d, by marginal likelihood; the given ones are the medians of priors.
    inducing
        See all data through few of its points, so that a search gets no slower with more data.
    periodic
        States that wrap enter as sine and cosine, so that the bias is the same after a turn; lists have one
        number for both.
    fourier_features
        Random frequencies, each with its sine and cosine, by which draws from the posterior vary where there
        are no data (`GPPosterior.draw`); 0: there they are zero.
    linear
        Prior standard deviation of the coefficients of a linear function that is added to each process: of
        scaled inputs, and of residuals over their root mean square. It holds far from the data, too, and is
        not weighted in Eq. 7. 0: none.
    """

    def __init__(
        self,
        task: Task,
        length_scale: Scale | list[Scale] = 1.0,
        signal_variance: Scale = 1.0,
        noise_variance: Scale = 0.018315638888734182,  # e^-4
        d: NonNegative = 1.0,
        input_scale: list[Scale] | None = None,
        learning: HyperPriors | None = None,
        inducing: Inducing | None = None,
        periodic: bool = False,
        fourier_features: CountOrZero = 0,
        linear: NonNegative = 0.0,
    ) -> None:
        self._task = task
        self._hyper = hyperparameters(
            task, length_scale, signal_variance, noise_variance, d, input_scale, periodic, linear
        )
        self._fourier_features = fourier_features
        self._learning = learning
        self._inducing = inducing

    def fit(self, transitions: Transitions) -> FittedBias:
        """Condition on the data; without data the mean is zero everywhere."""
        hyper = learn(self._hyper, transitions, self._learning) if self._learning else self._hyper
        if self._inducing:
            posterior = sparse(hyper, transitions, self._inducing, self._fourier_features)
        else:
            self._warn_of_a_slow_search(len(transitions))
            posterior = exact(hyper, transitions, self._fourier_features)
        if self._learning:
            posterior.diagnostics = {**posterior.diagnostics, **self._values(hyper)}
        return posterior

    def _values(self, hyper: Hyperparameters) -> dict[str, float]:
        """Learned hyper-parameters by name."""
        names = [quantity.name for quantity in (*self._task.states, *self._task.inputs)]
        names += [f"cosine_of_{names[angle]}" for angle in hyper.angles]
        lengths = zip(names, hyper.length_scale.tolist(), strict=True)
        return {
            **{f"length_scale_{name}": value for name, value in lengths},
            "signal_variance": hyper.signal_variance,
            "noise_variance": hyper.noise_variance,
        }

    def _warn_of_a_slow_search(self, N: int) -> None:
        seconds = STEPS_OF_A_SEARCH * SECONDS_PER_STEP * N**2
        if seconds > PATIENCE:
            better = "sparse_gp_learned" if self._learning else "sparse_gp"
            message = f"exact GP, {N} samples: a search takes about {seconds / 60:.0f} min; use bias={better}"
            warnings.warn(message, SlowWarning, stacklevel=3)
