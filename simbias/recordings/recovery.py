"""Parameter recovery: identification from simulated recordings of models with drawn parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import bdtr
from threadpoolctl import threadpool_limits

from simbias.core.errors import ConfigError
from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import QUANTILE
from simbias.learning.identification.posterior import Posterior
from simbias.recordings.findings import Finding, findings
from simbias.simulation.open_loop import PredictionModel, Windows, predict
from simbias.trial.study import Study

ROBOTS = 10
CHANCE = 0.1  # significance level for too few 90% intervals that contain the truth


class Recovery(NamedTuple):
    """How well a parameter was recovered, over robots drawn from current knowledge."""

    name: str
    unit: str
    error: float  # median distance from the truth, in standard deviations of the prior
    deviation: float  # median deviation of the posterior, in standard deviations of the prior
    held: float  # share of 90% intervals that contain the truth
    doubt: str  # why it is not recovered; "" if it is


class Take(NamedTuple):
    """An experiment that is repeated with every robot."""

    start: Array  # (n,)
    inputs: Array  # (T, m)
    times: Array | None = None  # (k,) measurement times in s after the start; None: in each frame
    recording: str = ""  # the recording it is a piece of; "": its own
    continues: bool = False  # as in `Rollout.continues`


@threadpool_limits.wrap(limits=1, user_api="blas")  # of small matrices: threads cost more than they save
def recover(
    study: Study,
    takes: Sequence[Take],
    noise: Array,
    robots: int = ROBOTS,
    progress: Callable[[str], None] = lambda words: None,
) -> list[Recovery]:
    """Draw robots from current knowledge, record each in all takes with white noise (n,), and identify it.

    A recording ends when the robot would fail.

    Raises
    ------
    ConfigError
        If no robot lasts for a window.
    """
    posterior = study.identification
    assert isinstance(posterior, Posterior)
    known = posterior.identified(study.nominal, [])
    (rng,) = np.random.default_rng(study.seed).spawn(1)  # the search for the mode uses the stream itself
    parameters = known.parameters
    own = np.array([parameter.of_recording for parameter in parameters], bool)
    true, modes, deviations, found = [], [], [], []
    for index in range(robots):
        progress(f"robot {index + 1} of {robots}")
        z, drawn, made = known.draw_coordinates(rng), dict[str, Array](), list[tuple[str, Rollout]]()
        for i, take in enumerate(takes):
            name = take.recording or str(i)
            if name not in drawn:
                drawn[name] = np.where(own, rng.standard_normal(len(z)), z) if i and own.any() else z
            made.append((name, record(study, PredictionModel(known.at(drawn[name])), take, noise, rng)))
        made = [(name, rollout) for name, rollout in made if rollout.frames]
        rollouts = [rollout for _, rollout in made]
        if not rollouts or not len(posterior.windows(rollouts)):
            continue
        fitted = posterior.identified(study.nominal, rollouts, [name for name, _ in made])
        first = fitted.of_recording(0)
        true.append(drawn[made[0][0]])
        modes.append(first.mode)
        deviations.append(np.sqrt(np.diag(first.covariance)))
        pairs = zip(own, findings(first, [], []), findings(fitted, [], []), strict=True)
        found.append([of_first if its_own else shared for its_own, of_first, shared in pairs])
    if not true:
        raise ConfigError("", "no drawn robot lasts for a window without failing")
    errors, spreads = np.abs(np.array(modes) - true), np.array(deviations)
    held = errors <= QUANTILE * spreads
    return [
        Recovery(
            parameter.name,
            parameter.unit,
            float(np.median(errors[:, i])),
            float(np.median(spreads[:, i])),
            float(np.mean(held[:, i])),
            doubt([each[i] for each in found], int(held[:, i].sum())),
        )
        for i, parameter in enumerate(parameters)
    ]


def doubt(found: Sequence[Finding], held: int) -> str:
    """Why a parameter is not recovered, from its finding for each robot; "" if it is.

    It is not trusted for most robots, or too few of the 90% intervals contain the truth.
    """
    doubts = Counter("; ".join(each.doubts) for each in found)
    if 2 * doubts.pop("", 0) <= len(found):
        return doubts.most_common(1)[0][0]
    return "interval too narrow" if bdtr(held, len(found), 0.9) < CHANCE else ""


def record(
    study: Study, model: PredictionModel, take: Take, noise: Array, rng: np.random.Generator
) -> Rollout:
    """A robot's rollout in a take until it fails, measured at the take's times, with noise (n,) in frames."""
    states = np.broadcast_to(take.start, (len(take.inputs) + 1, len(take.start)))
    windows = Windows.of([Rollout(states, take.inputs, continues=take.continues)], len(take.inputs), 1)
    x = np.vstack([take.start, predict([model], windows)[0, 0]])
    failed = np.flatnonzero(study.task.violated(x) >= 0)
    frames = max(0, failed[0] - 1) if len(failed) else len(take.inputs)
    x = x[: frames + 1]
    at = study.task.time_step * np.arange(frames + 1)
    times = at if take.times is None else take.times[take.times <= at[-1]]
    if not len(times):  # it fails before the first measurement
        return Rollout(x[:1], take.inputs[:0])
    white = rng.standard_normal((len(times), len(noise)))
    seen = [np.interp(at, times, np.interp(times, at, x[:, i])) for i in range(len(noise))]
    e = np.array([np.interp(at, times, each) for each in white.T]).T  # smaller, between samples
    measured = np.array(seen).T + noise * e * np.sqrt(np.mean(white**2, axis=0) / np.mean(e**2, axis=0))
    inputs = take.inputs[:frames]
    return Rollout(measured, inputs, measured=measured, sensed=True, continues=take.continues)
