"""Ways to learn a model from recordings: ours, the lab's, and what others would do."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from loading import Rig
from scipy.optimize import brentq, least_squares

from simbias.core import FittedBias, Nominal
from simbias.core.parameters import Parameter, values_at
from simbias.core.records import Array, Flags, Rollout
from simbias.learning.identification.identified import Identified, Known
from simbias.learning.identification.posterior import Posterior
from simbias.recordings.horizons import changes, errors, of_change, ratio, regions, spread
from simbias.recordings.parts import Part, others, parts
from simbias.simulation.open_loop import PredictionModel, predict
from simbias.trial.study import Study

GUARDED = (0.1, 0.2, 0.5)  # s
MOST_RATIO = 1.0  # of errors with a residual over those without, on any recording, at any horizon
MOST = 4.0  # prior standard deviations that least squares may go
SHIFT = 0.1  # prior standard deviations by which parameters differ from recording to recording


class Learned(NamedTuple):
    """What was learned from recordings."""

    model: Nominal  # of other recordings
    own: Sequence[Nominal]  # of each recording that was learned from
    bias: FittedBias | None = None
    apart: Sequence[Nominal] = ()  # of each, identified from the others, if there are several

    def errors(self, rollouts: Sequence[Rollout], frames: int) -> Array:
        """Errors (w, n) of predictions of other recordings."""
        return errors(self.model, rollouts, frames, self.bias)

    def covariances(self, known: Sequence[Rollout], rollouts: Sequence[Rollout], frames: int) -> Array:
        """Covariances (w, n, n) of these errors, sized by those of the recordings that are known.

        Of several, each is predicted by a model of the others, as yet others are. One tells of itself alone:
        how recordings differ is added. A share of the predicted change is added to either.
        """
        pairs = list(zip(self.apart or self.own, known, strict=True))
        wrong = np.concatenate([errors(model, [one], frames, self.bias) for model, one in pairs])
        moved = changes(self.errors(rollouts, frames), rollouts, frames)
        beyond = of_change(moved)
        if not isinstance(self.model, Identified):
            n = wrong.shape[1]
            return regions(np.zeros((len(moved), n, n)), wrong, np.zeros((len(wrong), n, n))) + beyond
        spreads = np.concatenate([spread(model, [one], frames) for model, one in pairs])
        if self.apart:
            return regions(spread(self.model, rollouts, frames), wrong, spreads) + beyond
        beyond += spread(of_shift(self.model), rollouts, frames, noisy=False)
        return regions(spread(of_shared(self.model), rollouts, frames), wrong, spreads) + beyond


def of_shared(model: Identified) -> Identified:
    """The model, uncertain in all but what each recording has of its own."""
    return model.with_spread(np.where(_own(model)[:, None], 0.0, model.spread))


def of_shift(model: Identified) -> Identified:
    """The model of other recordings, uncertain by how recordings differ alone.

    What each has of its own varies as declared, all else by `SHIFT`, as friction that warms.
    """
    return model.with_spread(np.diag(np.where(_own(model), 1.0, SHIFT)))


def _own(model: Identified) -> Flags:
    """Which parameters (p,) each recording has of its own."""
    return np.array([parameter.of_recording for parameter in model.parameters], bool)


Way = Callable[[Rig, Sequence[Rollout]], Learned]


def nominal(rig: Rig, rollouts: Sequence[Rollout]) -> Learned:
    """As drawn; nothing is learned."""
    return Learned(rig.study.nominal, [rig.study.nominal] * len(rollouts))


def lab(rig: Rig, rollouts: Sequence[Rollout]) -> Learned:
    """As the lab identified it, perhaps from these very recordings."""
    return Learned(rig.lab, [rig.lab] * len(rollouts))


def ordinary(rig: Rig, rollouts: Sequence[Rollout]) -> Learned:
    """Ordinary least squares over the same windows and parameters, in units of the nominal typical errors."""
    windows = _posterior(rig.study).windows(rollouts)
    parameters, observed = rig.prior.parameters, windows.means
    scale = np.median(np.abs(predict([PredictionModel(rig.prior)], windows)[0] - observed), axis=(0, 1))

    def residuals(z: Array) -> Array:
        model = rig.prior.with_parameters(values_at(parameters, z))
        made = (predict([PredictionModel(model)], windows)[0] - observed) / scale
        return np.nan_to_num(made, nan=1e3, posinf=1e3, neginf=-1e3).ravel()

    z = least_squares(residuals, np.full(len(parameters), 0.01), bounds=(-MOST, MOST), max_nfev=40).x
    elsewhere = np.where([parameter.of_recording for parameter in parameters], 0.0, z)
    here, there = (rig.prior.with_parameters(values_at(parameters, each)) for each in (z, elsewhere))
    return Learned(there, [here] * len(rollouts))


def sysid(rig: Rig, rollouts: Sequence[Rollout]) -> Learned:
    """MuJoCo's toolbox over the same windows, of the parameters that the mechanism has."""
    import mujoco_sysid  # lazily: the other ways need no such library

    model = mujoco_sysid.fit(rig.study, _posterior(rig.study).windows(rollouts))
    return Learned(model, [model] * len(rollouts))


def residual(rig: Rig, rollouts: Sequence[Rollout]) -> Learned:
    """A residual of the nominal model alone."""
    study = rig.study
    bias = study.bias.learn(study.no_data, rollouts, study.nominal)
    return Learned(study.nominal, [study.nominal] * len(rollouts), bias)


def identified(rig: Rig, rollouts: Sequence[Rollout]) -> Learned:
    """The posterior of the parameters."""
    pieces = [Part("", {"": (rollout,)}) for rollout in rollouts]
    apart = [
        fit(rig, others(pieces, i).rollouts).elsewhere() for i in range(len(rollouts) * (len(rollouts) > 1))
    ]
    return _posterior_of(rig, rollouts)._replace(apart=apart)


def with_residual(rig: Rig, rollouts: Sequence[Rollout]) -> Learned:
    """The posterior, and a residual of its mode."""
    found = _posterior_of(rig, rollouts)
    return found._replace(bias=_bias(rig.study, found, rollouts))


def guarded(rig: Rig, rollouts: Sequence[Rollout]) -> Learned:
    """The same, without the residual where it may hurt.

    Each recording (of a single one, each third) is predicted by what is learned from the others, with and
    without the residual. It is left out if it makes predictions of any of them worse, at any horizon.
    """
    found = with_residual(rig, rollouts)
    pieces = parts({str(i): (rollout,) for i, rollout in enumerate(rollouts)})
    for i, piece in enumerate(pieces):
        of_rest = with_residual(rig, others(pieces, i).rollouts)
        if len(rollouts) == 1:  # thirds have its zeros
            of_rest = of_rest._replace(model=of_rest.own[0])
        for seconds in GUARDED:
            k = rig.study.task.frames(seconds)
            wrong = [each.errors(piece.rollouts, k) for each in (of_rest, of_rest._replace(bias=None))]
            if len(wrong[0]) and ratio(*wrong) > MOST_RATIO:
                return found._replace(bias=None)
    return found


WAYS: dict[str, Way] = {
    "nominal": nominal,
    "lab": lab,
    "least squares": ordinary,
    "mujoco.sysid": sysid,
    "residual": residual,
    "identified": identified,
    "identified and residual": with_residual,
    "identified and guarded residual": guarded,
}
OF_SEVERAL = ("lab", "identified", "identified and residual", "identified and guarded residual")


def of_lab(rig: Rig) -> Known:
    """The lab's parameters, which are certain, and the prior of zeros."""
    parameters = rig.prior.parameters
    values = {parameter.name: parameter.value for parameter in parameters} | rig.lab_values
    mode = [_coordinate(parameter, values[parameter.name]) for parameter in parameters]
    own = np.diag([float(p.of_recording) for p in parameters])
    return Known([p.name for p in parameters], mode, own.tolist())


def _coordinate(parameter: Parameter, value: float) -> float:
    """Where a parameter has this value."""
    if parameter.at(0.0) == value:
        return 0.0
    return float(brentq(lambda z: parameter.at(z) - value, -30.0, 30.0))


def timed(way: Way, rig: Rig, rollouts: Sequence[Rollout]) -> tuple[Learned, float]:
    """What a way learns, and the processor time in s that it takes."""
    begin = time.process_time()
    return way(rig, rollouts), time.process_time() - begin


def _posterior(study: Study) -> Posterior:
    """The study's identification."""
    assert isinstance(study.identification, Posterior)
    return study.identification


def fit(rig: Rig, rollouts: Sequence[Rollout], known: Known | None = None) -> Identified:
    """The model identified from recordings, after what is known."""
    posterior = _posterior(rig.study) if known is None else _posterior(rig.study).with_known(known)
    model = posterior.fit(rig.study.nominal, rollouts)
    assert isinstance(model, Identified)
    return model


def _posterior_of(rig: Rig, rollouts: Sequence[Rollout]) -> Learned:
    """The posterior of the parameters, of other recordings and of each."""
    model = fit(rig, rollouts)
    return Learned(model.elsewhere(), [model.of_recording(i) for i in range(len(rollouts))])


def _bias(study: Study, found: Learned, rollouts: Sequence[Rollout]) -> FittedBias:
    """A residual of the model, from recordings without their zeros."""
    level = [_without_zeros(study, model, one) for model, one in zip(found.own, rollouts, strict=True)]
    return study.bias.learn(study.no_data, level, found.model)


def _without_zeros(study: Study, model: Nominal, rollout: Rollout) -> Rollout:
    """A recording as encoders without zeros would have made it."""
    assert isinstance(model, Identified)
    values = {estimate.name: estimate.value for estimate in model.estimates}
    zeros = np.array([values.get(f"{state.name}.zero", 0.0) for state in study.task.states])
    states = rollout.states - zeros
    return Rollout(states, rollout.inputs, measured=states, sensed=True)
