"""`python -m simbias identify`: a model from recordings, and which of its parameters to trust."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from simbias.config import ConfigError
from simbias.config.build import NOT_OF_RECORDINGS
from simbias.lab.recorded import Recorded
from simbias.learning.noise import noise_of
from simbias.recordings import words
from simbias.recordings.assessment import Assessment, assess
from simbias.recordings.excitation import Designer, Excitation
from simbias.recordings.files import OPTION, check_replaces_nothing, write
from simbias.recordings.fitting import LONGEST
from simbias.recordings.reading import Recordings, learned_files, read_apart
from simbias.recordings.study import GROUP, study_of
from simbias.terminal.lines import progress, say, standard_output
from simbias.terminal.notices import preparing
from simbias.trial.study import Study

SECONDS, TRAJECTORIES = 5.0, 40  # of the next excitation
CHOSEN = r"(?!(true|false|null|nan|inf)$)[a-z]"  # start of an option that Hydra takes for a plain word


class Request(NamedTuple):
    """Recordings, overrides and folders, as the command line names them."""

    recordings: Sequence[str]
    held_out: Sequence[str]
    overrides: Sequence[str]
    columns: Mapping[str, str] | None
    folder: Path
    config_dir: str | None
    allow: Sequence[str]

    @property
    def configs(self) -> Path:
        """The folder of configs to which the identified option is written."""
        return Path(self.config_dir) if self.config_dir else self.folder / "conf"

    @property
    def option(self) -> Path:
        """The option's file; beside the user's own options, it is named after the folder of results."""
        name = re.sub(r"[^A-Za-z0-9_]", "_", self.folder.name) if self.config_dir else ""
        if not re.match(CHOSEN, name, re.IGNORECASE):
            name = f"{OPTION}_{name}" if name else OPTION
        return self.configs / GROUP / f"{name}.yaml"

    def opened(
        self, console: Console, windows: float = 1.0, attach: bool = False, again: bool = False
    ) -> tuple[Study, Recordings, Recordings]:
        """The study, its recordings and the held-out ones; notes on them are printed.

        From recordings not held out, pieces with fewer than `windows` windows are left out, and so is what
        the earlier posterior has learned, unless it may count `again`. The study has the components needed
        for recordings or, with an attached trial, all components.
        """
        with preparing():
            left_out = () if attach else NOT_OF_RECORDINGS
            study = study_of(self.overrides, self.config_dir, self.allow, left_out)
        places = self.recordings, self.held_out
        recordings, held_out = read_apart(study, *places, self.columns, windows, again)
        for note in (*recordings.notes, *held_out.notes):
            say(console, note, "yellow")
        if extent := ", ".join(filter(None, (recordings.extent, held_out.extent))):
            say(console, extent)
        return study, recordings, held_out

    @property
    def again(self) -> list[str]:
        """The overrides of a trial that begins with the identified model."""
        return [each for each in self.overrides if not each.startswith(f"{GROUP}=")] + [
            f"{GROUP}={self.option.stem}"
        ]


def identify(request: Request, attach: bool = False) -> bool:
    """Identify a model, print and write the results; return whether it is better, and no column seems wrong.

    If no parameter is trusted, it is not good enough for an attached trial.

    A ConfigError names a bad override, an unreadable recording, an unwritable file, or the hardware of an
    attached trial that has no recordings.
    """
    console = standard_output()
    study, recordings, held_out = request.opened(console, LONGEST, attach)
    if attach and isinstance(study.hardware, Recorded) and not study.hardware.source_files:
        problem = "has no recording to start a trial with (--attach); choose another hardware"
        raise ConfigError("hardware.folder", problem)
    check_replaces_nothing(study, request.folder, request.option)
    with progress(console) as tell_of:
        assessment = assess(
            study,
            recordings.rollouts,
            held_out.rollouts,
            lambda each: tell_of(f"fitting {each}"),
            recordings.doubt,
        )
        tell_of("searching for what to record next")
        excitation = next_excitation(study, assessment)
    notes = (*recordings.notes, *held_out.notes)
    try:
        write(assessment, excitation, study.config[GROUP], request.folder, request.option, notes)
    except OSError as error:
        raise ConfigError(str(request.folder), f"cannot be written ({error.strerror})") from error
    tell(console, assessment, excitation)
    say(console, f"Look at it:  {request.folder / 'report.html'}")
    again = f"--config-dir {request.configs} {GROUP}={request.option.stem}"
    begin = f"{words.beginning(assessment)}  {again}" if assessment.better else "Start no trial with it"
    say(console, f"{begin}  ({request.option})")
    if attach and not assessment.sound:
        say(console, "No trial is started.")
        return False
    for name in learned_files(study, assessment.learned) if attach else ():
        say(console, f"The model has learned {name}, which counts again in the trial.", "yellow")
    return assessment.better and not assessment.mistakes


def next_excitation(study: Study, assessment: Assessment) -> Excitation | str:
    """The most informative trajectory to record next, or the reason why there is none."""
    if not assessment.better:
        return "it would rely on the identified model, which should not be used"
    rollouts = [rollout for part in assessment.parts for rollout in part.rollouts]
    try:
        designer = Designer(study, assessment.identified, noise_of(rollouts))
        return designer.design(SECONDS, TRAJECTORIES, np.random.default_rng(0))
    except ConfigError as error:
        return str(error)


def tell(console: Console, assessment: Assessment, excitation: Excitation | str) -> None:
    """Print the tables and sentences."""
    table(console, words.PARAMETER_NAMES, list(words.parameter_rows(assessment)))
    say(console, words.TRUST)
    for line in words.own_lines(assessment):
        say(console, f"Specific to {line}")
    for line in words.undetermined_lines(assessment):
        say(console, f"Not determined: {line}")
    table(console, words.error_names(assessment), list(words.error_rows(assessment)))
    say(console, words.about_errors(assessment))
    for line in words.reach_lines(assessment):
        say(console, f"Extrapolation: {line}")
    for line in words.advice(assessment, excitation):
        say(console, f"Next: {line}")
    say(console, words.verdict(assessment))


def table(console: Console, names: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table with its first and last columns left-aligned."""
    widths = [max(map(len, column)) for column in zip(names, *rows, strict=True)]
    for row in (names, *rows):
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        cells[0], cells[-1] = row[0].ljust(widths[0]), row[-1]
        say(console, "  ".join(cells))
    console.print()
