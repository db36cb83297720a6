"""Trust in identified parameters: findings about each, and about their combinations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simbias.core.parameters import Estimate, Parameter
from simbias.core.records import Array
from simbias.learning.identification.identified import QUANTILE, Identified

CORRELATED = 0.9
COMPENSATES = 0.5  # correlation from which a parameter partly compensates for another's error
DETERMINED, UNKNOWN = 0.5, 0.2  # shrinkage from which a parameter is determined; below 0.2 it is unknown
BEYOND_PRIOR = 1.05  # prior deviations: a larger posterior deviation exceeds the prior
AT_BOUND = 0.05  # prior standard deviations from a bound
TAIL = 2.5  # prior standard deviations from the median
DISAGREEMENT = 3.0  # standard deviations between estimates of two parts
FAR = "far from its declared value"
STEP_DOUBT = "depends on the integration step"
TOO_LONG = 1.0  # standard deviations by which shorter integration steps move estimates


@dataclass(frozen=True)
class Finding:
    """An identified parameter, its shrinkage by the data, and doubts about its value.

    Further recordings may remove passing doubts, which are about the posterior. Lasting ones, about the
    recordings and the model, stay where identification begins with this posterior.
    """

    prior: Parameter  #: as declared
    estimate: Estimate  #: as identified
    shrinkage: float  #: of the standard deviation, in the prior's coordinate: 0 nothing learned, 1 exact
    partners: Mapping[str, float]  #: parameters correlated with it by more than 0.9
    by_part: tuple[Estimate, ...]  #: identified from each part alone
    passing: tuple[str, ...]
    lasting: tuple[str, ...]
    earlier: tuple[str, ...] = ()  #: lasting doubts of the runs that led to the prior

    @property
    def doubts(self) -> tuple[str, ...]:
        """All doubts in words."""
        earlier = ", ".join(each for each in self.earlier if each not in self.lasting)
        return *self.passing, *self.lasting, *([f"doubted earlier: {earlier}"] if earlier else [])

    @property
    def trusted(self) -> bool:
        """Whether there is no doubt about the parameter."""
        return not self.doubts

    @property
    def prior_interval(self) -> tuple[float, float]:
        """5% and 95% quantiles of the prior."""
        low, high = self.prior.at(np.array([-QUANTILE, QUANTILE])).tolist()
        return low, high


def findings(
    fitted: Identified,
    by_part: Sequence[Identified],
    by_window: Sequence[Identified],
    shorter: Array | float = 0.0,
    apart: Sequence[Identified] = (),
) -> list[Finding]:
    """A finding for each parameter, with its doubts.

    Shorter integration steps would move them by these numbers (p,) of standard deviations. `apart` are an
    earlier posterior, with which the fit begins, and the one that the recordings give without it.
    """
    deviations = np.sqrt(np.diag(fitted.covariance))
    R = fitted.covariance / np.outer(deviations, deviations)
    names = [parameter.name for parameter in fitted.parameters]
    disagree, differ = (
        [
            _distance(fits, i) > DISAGREEMENT and not parameter.of_recording
            for i, parameter in enumerate(fitted.parameters)
        ]
        for fits in (by_part, apart)
    )
    found, shifts = [], np.broadcast_to(shorter, len(names))
    for i, (parameter, estimate) in enumerate(zip(fitted.parameters, fitted.estimates, strict=True)):
        shrinkage = float(np.clip(1.0 - deviations[i], 0.0, 1.0))
        partners = {
            names[j]: float(R[i, j]) for j in range(len(names)) if j != i and abs(R[i, j]) > CORRELATED
        }
        elsewhere = parameter.of_recording and not shrinkage  # only the prior is known
        # The lower end of a half-normal is the declared value.
        tail = fitted.mode[i] if parameter.prior == "half_normal" else abs(fitted.mode[i])
        passing = [
            "specific to each recording" if elsewhere else _of_shrinkage(shrinkage),
            "wider than its prior" if deviations[i] > BEYOND_PRIOR else "",
            f"only together with {', '.join(partners)}" if partners else "",
            "at its bound" if at_bound(parameter, estimate.value) else "",
            FAR if tail > TAIL else "",
            f"at the assumed {parameter.assumed}" if parameter.assumed else "",
        ]
        lasting = [
            _of_contradiction("recordings disagree", disagree, i, R[i], names),
            "depends on the window" if _moved(fitted, by_window, i) > DISAGREEMENT else "",
            STEP_DOUBT if shifts[i] > TOO_LONG else "",
            _of_contradiction("the earlier posterior disagrees", differ, i, R[i], names),
        ]
        alone = tuple(each.estimates[i] for each in by_part)
        doubts = (tuple(filter(None, each)) for each in (passing, lasting))
        found.append(Finding(parameter, estimate, shrinkage, partners, alone, *doubts))
    return found


def at_bound(parameter: Parameter, value: float) -> bool:
    """Whether a value lies at an end of the prior, if it has one."""
    ends = {"half_normal": [0.0], "uniform": [0.0, parameter.spread]}.get(parameter.prior, [])
    width = parameter.spread * (1.0 if parameter.prior == "half_normal" else 12**-0.5)
    return any(abs(value - parameter.value - end) < AT_BOUND * width for end in ends)


def _of_shrinkage(shrinkage: float) -> str:
    """The doubt about a parameter with this shrinkage; "" if there is none."""
    if shrinkage < UNKNOWN:
        return "not determined by the data"
    return "partly determined" if shrinkage < DETERMINED else ""


def _of_contradiction(
    words: str, disagree: Sequence[bool], i: int, correlations: Array, names: Sequence[str]
) -> str:
    """The doubt about a parameter if estimates of it disagree, or of one that compensates for it; else ""."""
    pairs = zip(names, correlations, disagree, strict=True)
    shaken = [name for name, r, each in pairs if each and abs(r) > COMPENSATES]
    return words if disagree[i] else f"{words} on {', '.join(shaken)}" if shaken else ""


def _distance(fits: Sequence[Identified], i: int) -> float:
    """The largest distance of a coordinate between two fits, in its standard deviations."""
    z = np.array([fit.mode[i] for fit in fits])
    variance = np.array([fit.covariance[i, i] for fit in fits])
    distances = np.abs(z[:, None] - z) / np.sqrt(variance[:, None] + variance)
    return float(distances.max(initial=0.0))


def _moved(fitted: Identified, fits: Sequence[Identified], i: int) -> float:
    """How far a coordinate moves with the window, in the larger of its standard deviations."""
    moved = (
        abs(fit.mode[i] - fitted.mode[i]) / np.sqrt(max(fit.covariance[i, i], fitted.covariance[i, i]))
        for fit in fits
    )
    return max(moved, default=0.0)
