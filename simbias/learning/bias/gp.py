"""Gaussian-process regression of the dynamics bias."""

from __future__ import annotations

import warnings

from simbias.core import Bias, FittedBias, StudyWarning, Task
from simbias.core.ranges import CountOrZero, NonNegative, Scale
from simbias.core.records import Transitions
from simbias.learning.bias.inducing import Inducing
from simbias.learning.bias.posterior import exact, sparse
from simbias.learning.covariance import Hyperparameters, hyperparameters
from simbias.learning.likelihood import HyperPriors, learn

# By sweeps/benchmarks/gp.py, batched on one thread: 11 us at N = 1000, growing faster than N^2 beyond.
SECONDS_PER_STEP = 11e-6 / 1000**2
STEPS_OF_A_SEARCH = 3.8e6  # for 1000 policies, some of which fall early
PATIENCE = 60.0  # s: longer searches are warned of; N = 1200


class GaussianProcess(Bias):
    """One Gaussian process for each state, all with the same hyper-parameters (Section IV-B, Table I).

    Parameters
    ----------
    length_scale
        Length scale of the scaled inputs: one number, or one for each state and input.
    signal_variance, noise_variance
        alpha^2 and sigma^2 of Eq. 3, for residuals divided by their root mean square.
    d
        Weight in Eq. 7 of the variance, summed over all states; 0: the unweighted mean.
    input_scale
        One number for each state and input; by default 1 for a state, and the limit for an input.
    learning
        How to learn the hyper-parameters, except d, by marginal likelihood; the given ones are prior medians.
    inducing
        How to represent all data by a few inducing points, so that more data do not slow down a search.
    periodic
        Whether states that wrap enter as sine and cosine, so that the bias is periodic; lists have one number
        for both.
    fourier_features
        Number of random frequencies, each with sine and cosine. They let draws from the posterior vary far
        from the data (`GPPosterior.draw`); 0: draws vanish there.
    linear
        Prior standard deviation of the coefficients of a linear function added to each process, for scaled
        inputs and residuals divided by their root mean square. The function extends far from the data, and is
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
            warnings.warn(message, StudyWarning, stacklevel=3)
