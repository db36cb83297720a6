"""`python -m simbias excite` and `identify --recover`: the information in recordings before they are made."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from simbias.config import ConfigError
from simbias.core.errors import reason
from simbias.core.records import Array
from simbias.learning.identification.posterior import Posterior
from simbias.learning.noise import noise_of
from simbias.recordings.excitation import FURTHER, MODELS, Designer, Excitation
from simbias.recordings.files import trajectory
from simbias.recordings.recovery import Take, recover
from simbias.terminal.identify import Request, table
from simbias.terminal.lines import progress, say, standard_output
from simbias.trial.study import Study

SECONDS, TRAJECTORIES = 5.0, 200
LOOKING = "searching for the most informative inputs"
COMES_BACK = (
    "A parameter comes back if identify would trust it for most robots, and at least 8 of 10 of its 90% "
    "intervals contain the true value; by chance, fewer do in 7 of 100 cases."
)
BOUND = "Deviations afterwards are lower bounds: identify also accounts for the scatter of errors."
LEAST, MOST = 0.01, 3600.0  # s of inputs
RARELY = 0.05  # share of robots beyond the limits: up to this, no remedy is suggested


def excite(request: Request, seconds: float, file: Path) -> None:
    """Write the most informative inputs within the limits, and print their expected information.

    ConfigError if no inputs of this duration keep the limits, or the file cannot be written.
    """
    if not LEAST <= seconds <= MOST:
        raise ConfigError("--seconds", f"must be from {LEAST:g} to {MOST:g}, got {seconds:g}")
    console = standard_output()
    with _writing(file):  # checked before the long search for inputs
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.is_dir():
            raise IsADirectoryError("it is a folder")
    study, given, _ = request.opened(console)
    learned = given.pieces
    with progress(console) as tell_of:
        tell_of(LOOKING)
        posterior = study.identification
        assert isinstance(posterior, Posterior)
        model = posterior.fit(study.nominal, learned.rollouts, learned.recordings)
        designer = Designer(study, model, noise_of(learned.rollouts) if learned.rollouts else None)
        found = designer.design(seconds, TRAJECTORIES, np.random.default_rng(study.seed), tell_of)
        beyond = designer.beyond(found.rollout.inputs)
    with _writing(file):
        trajectory(study.task, found.rollout).to_csv(file, index=False, float_format="%.6g")
    names = ("parameter", "unit", "deviation now", "afterwards")
    rows = [
        (parameter.name, parameter.unit, f"{before:.2f}", f"{after:.2f}")
        for parameter, before, after in zip(
            designer.nominal.parameters, designer.before, found.deviations, strict=True
        )
    ]
    table(console, names, rows)
    say(console, "Deviations are relative to the prior's.")
    if not learned.rollouts:
        say(console, BOUND)
        say(console, f"This assumes an exact model and white noise of {_levels(study, designer.noise)}.")
        say(console, "With recordings, in place of an option identified from them, model errors count, too.")
    say(console, f"The most probable model and {MODELS - 1} draws stay within {_extremes(study, found)}.")
    remedy = ": tighten hardware.safety, or scale the inputs down" if beyond > RARELY else ""
    say(console, f"Of {FURTHER} other draws, {beyond:.0%} exceed the limits{remedy}.")
    say(console, f"Look at it:  {file}")


@contextmanager
def _writing(file: Path) -> Iterator[None]:
    """Convert system errors to one line that names the file."""
    try:
        yield
    except OSError as error:
        raise ConfigError(str(file), f"cannot be written ({reason(error)})") from error


def recovery(request: Request) -> bool:
    """Print which parameters of drawn robots are recovered from recordings like these; return whether any is.

    Without recordings, designed inputs are used, with measurements in each frame. ConfigError if a recording
    cannot be read, all are held out, or no inputs keep the limits.
    """
    console = standard_output()
    study, recordings, _ = request.opened(console, again=True)
    if request.recordings and not recordings.rollouts:
        raise ConfigError("--held-out", "holds out every recording")
    with progress(console) as tell_of:
        takes = [
            Take(piece.states[0], piece.inputs, times, name, piece.continues)
            for name, pieces in recordings.rollouts.items()
            for piece, times in zip(pieces, recordings.times[name], strict=True)
        ]
        if takes:
            noise = noise_of(recordings.pieces.rollouts)
        else:
            tell_of(LOOKING)
            designer = Designer(study, study.identification.fit(study.nominal, []))
            found = designer.design(SECONDS, TRAJECTORIES, np.random.default_rng(study.seed), tell_of).rollout
            takes, noise = [Take(found.states[0], found.inputs)], designer.noise
        recovered = recover(study, takes, noise, progress=tell_of)
    names = ("parameter", "unit", "error", "deviation", "90% interval holds it", "comes back")
    rows = [
        (
            each.name,
            each.unit,
            f"{each.error:.2f}",
            f"{each.deviation:.2f}",
            f"{100 * each.held:.0f}%",
            each.doubt or "yes",
        )
        for each in recovered
    ]
    table(console, names, rows)
    say(console, "Medians over robots drawn from the prior, or from an identified option's posterior.")
    say(console, "Deviations are relative to the prior's.")
    say(console, COMES_BACK)
    say(console, f"White noise of {_levels(study, noise)}.")
    return not all(each.doubt for each in recovered)


def _levels(study: Study, noise: Array) -> str:
    """The noise (n,) of each state, in words."""
    pairs = zip(study.task.states, noise, strict=True)
    return ", ".join(f"{state.name} {level:.2g} {state.unit}" for state, level in pairs)


def _extremes(study: Study, found: Excitation) -> str:
    """The largest magnitudes of states and inputs, in words."""
    quantities = (*study.task.states, *study.task.inputs)
    largest = (*found.largest, *np.abs(found.rollout.inputs).max(axis=0))
    return ", ".join(
        f"|{quantity.name}| < {value:.3g} {quantity.unit}"
        for quantity, value in zip(quantities, largest, strict=True)
    )
