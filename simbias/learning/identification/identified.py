"""The identified parameters of a nominal model, and a known posterior as their prior."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import final

import numpy as np
from scipy.linalg import qr

from simbias.core import Nominal
from simbias.core.errors import ConfigError
from simbias.core.model import drawn
from simbias.core.parameters import Estimate, Parameter, values_at
from simbias.core.ranges import Coordinate
from simbias.core.records import Array, Indices
from simbias.learning.prediction_errors import ErrorDistribution

QUANTILE = 1.6449  # 95% of a standard normal


@dataclass(frozen=True)
class Known:
    """A posterior as numbers: normal in the coordinates of p parameters' declared priors."""

    parameters: list[str]  # their names, in the model's order
    mode: list[Coordinate]  # (p,)
    spread: list[list[Coordinate]]  # (p, p) a square root of the covariance
    declared: list[str] | None = None  # (p,) the priors of the coordinates, in words; None: unknown
    model: str | None = None  # digest of its nominal model (`simbias.trial.origin`); None: any
    # What later runs of `identify` need, and no trial: doubts (p) that its recordings cause, and digests of
    # these (`simbias.recordings.copies`). None: unknown.
    doubts: list[list[str]] | None = field(default=None, compare=False)
    learned: list[str] | None = field(default=None, compare=False)


@final
class Identified(Nominal):
    """The nominal model at the mode of its parameters; `draw` samples their posterior."""

    def __init__(
        self,
        prior: Nominal,
        mode: Array,
        spread: Array,
        diagnostics: Mapping[str, float],
        errors: ErrorDistribution | None = None,
    ) -> None:
        self._prior = prior
        self.mode = mode  # (p,) coordinates
        self.model = prior.with_parameters(values_at(prior.parameters, mode))
        self.kernel = self.model.kernel
        self.parameters = prior.parameters
        self.state_size, self.acting = self.model.state_size, self.model.acting
        self.diagnostics = diagnostics
        self.recordings: tuple[Identified, ...] = ()  # the models of the recordings, if these differ
        self.errors = errors  # of window predictions, at the mode
        self.spread = spread  # (p, p or more), square root of the covariance
        self.covariance = spread @ spread.T  # (p, p) of the coordinates
        deviations = QUANTILE * np.sqrt(np.diag(self.covariance))
        self.estimates = tuple(
            Estimate(p.name, p.unit, p.value, float(p.at(z)), float(p.at(z - d)), float(p.at(z + d)))
            for p, z, d in zip(prior.parameters, mode, deviations, strict=True)
        )

    @property
    def mean_deviation(self) -> float:
        """Standard deviation of the coordinates, as a geometric mean over directions."""
        return float(np.exp(np.linalg.slogdet(self.covariance)[1] / (2 * len(self.mode))))

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n) of the most probable model."""
        return self.model.step(x, u)

    def advance(self, x: Array, u: Array, model_state: Array) -> tuple[Array, Array]:
        """x_next (..., n), and the model state (..., s), of the most probable model."""
        return self.model.advance(x, u, model_state)

    def model_states(self, states: Array, inputs: Array) -> Array:
        """Model states (k, s) in each frame of a record."""
        return self.model.model_states(states, inputs)

    def with_parameters(self, values: Array) -> Nominal:
        """The model with other values (k,) of its parameters."""
        return self._prior.with_parameters(values)

    @property
    def slack(self) -> Array:
        """The slack of the most probable model."""
        return self.model.slack

    def without_dry_friction(self) -> Nominal:
        """The most probable model without dry friction."""
        return self.model.without_dry_friction()

    def narrowed(self, scale: float) -> Identified:
        """The model at the same mode, with `scale` times the standard deviations of the posterior."""
        return self.with_spread(scale * self.spread)

    @staticmethod
    def of_recordings(
        prior: Nominal, z: Array, spread: Array, places: Indices, errors: ErrorDistribution
    ) -> Identified:
        """The posterior of coordinates z (P,); `places` (r, p) index those of r pieces of recordings.

        Pieces of one recording share their coordinates. If several recordings have specific parameters, the
        result is the model for further recordings.
        """
        each = tuple(Identified(prior, z[at], spread[at], {}, errors) for at in np.unique(places, axis=0))
        if len(z) == places.shape[1]:
            return each[0]
        fitted = each[0].elsewhere()
        fitted.recordings = each
        return fitted

    def of_recording(self, index: int) -> Identified:
        """The model of one of its recordings, with that recording's specific parameters."""
        return self.recordings[index] if self.recordings else self

    def elsewhere(self) -> Identified:
        """The model for other recordings, whose specific parameters are known only by their prior."""
        own = np.array([parameter.of_recording for parameter in self.parameters], bool)
        if not own.any():
            return self
        shared, spread = np.flatnonzero(~own), np.diag(own.astype(float))
        # The shared parameters keep their posterior spread; specific ones have that of the prior.
        spread[np.ix_(shared, shared)] = qr(self.spread[shared].T, mode="economic")[1].T
        return Identified(self._prior, np.where(own, 0.0, self.mode), spread, self.diagnostics, self.errors)

    @property
    def known(self) -> Known:
        """The posterior as numbers."""
        names = [parameter.name for parameter in self.parameters]
        declared = [_declared(parameter) for parameter in self.parameters]
        return Known(names, self.mode.tolist(), self.spread.tolist(), declared)

    def with_spread(self, spread: Array) -> Identified:
        """The model at the same mode, with another square root (p, q) of the covariance."""
        return Identified(self._prior, self.mode, spread, self.diagnostics, self.errors)

    def at(self, coordinates: Array) -> Nominal:
        """The model with its parameters at coordinates (p,)."""
        return self._prior.with_parameters(values_at(self._prior.parameters, coordinates))

    def draw(self, rng: np.random.Generator) -> Nominal:
        """A model with parameters drawn from the posterior."""
        return self._drawn(rng)[1]

    def draw_coordinates(self, rng: np.random.Generator) -> Array:
        """The coordinates (p,) of a model drawn from the posterior."""
        return self._drawn(rng)[0]

    def _drawn(self, rng: np.random.Generator) -> tuple[Array, Nominal]:
        """Coordinates (p,) drawn from the posterior, and the model at them."""
        return drawn(lambda: self.mode + self.spread @ rng.standard_normal(self.spread.shape[1]), self.at)

    @staticmethod
    def of_prior(prior: Nominal) -> Identified:
        """The model with its prior as posterior, before any recording."""
        p = len(prior.parameters)
        return Identified(prior, np.zeros(p), np.eye(p), {})


@final
class KnownPrior(Nominal):
    """A model whose prior is a known posterior; its parameters are independent standard normal numbers.

    Raises
    ------
    ConfigError
        If the posterior belongs to other parameters or other declared values, or is incomplete.
    """

    def __init__(self, nominal: Nominal, known: Known) -> None:
        names = [parameter.name for parameter in nominal.parameters]
        if names != known.parameters:
            problem = f"is for {', '.join(known.parameters)}; the nominal model's parameters are "
            raise ConfigError("identification.known", problem + (", ".join(names) or "none"))
        if [len(known.mode), len(known.spread), *map(len, known.spread)] != [len(names)] * (2 + len(names)):
            raise ConfigError("identification.known", f"mode and spread must be for {len(names)} parameters")
        if known.doubts is not None and len(known.doubts) != len(names):
            raise ConfigError("identification.known.doubts", f"must be for {len(names)} parameters")
        declared = [_declared(parameter) for parameter in nominal.parameters]
        for name, before, now in zip(names, known.declared or declared, declared, strict=True):
            if before != now:
                problem = f"is for {name} declared as {before}; it is now {now}"
                raise ConfigError("identification.known", problem)
        self._nominal = nominal
        self._mode, self._spread = np.array(known.mode), np.array(known.spread)
        own = [
            parameter.of_recording and known.spread[i] == np.eye(len(names))[i].tolist()
            for i, parameter in enumerate(nominal.parameters)
        ]
        self.parameters = tuple(
            Parameter(name, "", 0.0, 1.0, of_recording=each) for name, each in zip(names, own, strict=True)
        )

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n) of the model as declared."""
        return self._nominal.step(x, u)

    def with_parameters(self, values: Array) -> Nominal:
        """The model at standard normal numbers (p,)."""
        return self._nominal.with_parameters(values_at(self._nominal.parameters, self._coordinates(values)))

    def posterior(self, fitted: Identified | None) -> Identified:
        """The posterior of the model: the earlier one or, with a fit, that given experiments too."""
        if fitted is None:
            return Identified(self._nominal, self._mode, self._spread, {})
        mode, spread = self._coordinates(fitted.mode), self._spread @ fitted.spread
        whole = Identified(self._nominal, mode, spread, fitted.diagnostics, fitted.errors)
        whole.recordings = tuple(self.posterior(each) for each in fitted.recordings)
        return whole

    def numbers(self, coordinates: Array) -> Array:
        """The standard normal numbers (p,) of coordinates of the declared priors (p,)."""
        return np.asarray(np.linalg.lstsq(self._spread, coordinates - self._mode)[0])

    def deviations(self, numbers: Array) -> Array:
        """Differences of coordinates of the declared priors (..., p) for those of numbers (..., p)."""
        return numbers @ self._spread.T

    def _coordinates(self, values: Array) -> Array:
        return self._mode + self._spread @ values


def _declared(parameter: Parameter) -> str:
    """A parameter's prior as a distinctive text."""
    return f"{parameter.value:.6g} {parameter.unit} ({parameter.prior} of spread {parameter.spread:.6g})"
