"""Learn the bias between a simulation and the hardware; optimise policies with few hardware experiments."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pandas import DataFrame

    from simbias.recordings.assessment import Assessment
    from simbias.sweep.running import SweepObserver
    from simbias.trial.run import TrialRecord
    from simbias.trial.study import Study

__version__ = "0.1.0"


def load(
    overrides: Sequence[str] = (), config_dir: Path | str | None = None, allow: Sequence[str] = ()
) -> Study:
    """Compose a study with the same overrides as on the command line.

    >>> study = load(["bias=none", "hardware.noise.torque_variance=0.1", "seed=3"])

    Custom components lie beside `config_dir`, or in modules that `allow` names.

    Raises
    ------
    simbias.config.ConfigError
        If an override or a value is bad; the message is one line that names the key.
    """
    from simbias.config import compose  # lazily: the command line's --help needs no components
    from simbias.config.build import build

    return build(compose(overrides, config_dir, allow))


def load_trial(
    trial: Path | str,
    *,
    uri: str = "sqlite:///mlflow.db",
    config_dir: Path | str | None = None,
    allow: Sequence[str] = (),
) -> TrialRecord:
    """Read back a trial: its study, its iterations and its outcome. The trial may still be running.

    >>> trial = load_trial("trials/7a29f4c5425f")

    `trial` is a trial's folder, or the id of its run in the MLflow store `uri`. A folder needs no store. For
    custom components see `load`; a warning names modules and files that have changed since it began.

    Raises
    ------
    simbias.config.ConfigError
        If there is no such trial, or it cannot be read; the message is one line.
    """
    from simbias.config.stored import read_folder

    if Path(trial).is_dir():
        return read_folder(Path(trial), config_dir, allow)
    from simbias.mlflow.stored import trial_folder  # lazily: MLflow takes seconds

    with trial_folder(str(trial), uri) as folder:
        return read_folder(folder, config_dir, allow)


def run_sweep(
    overrides: Sequence[str],
    config_dir: Path | str | None = None,
    observer: SweepObserver | None = None,
    allow: Sequence[str] = (),
) -> DataFrame:
    """Run or resume a sweep; return one row per trial.

    >>> trials = run_sweep(["+sweep=smoke", "engine=sequential"])

    Raises
    ------
    simbias.config.ConfigError
        If the sweep is invalid; in that case nothing has run.
    simbias.sweep.figure.UndrawnError
        If a figure cannot be drawn; the error has the trials.
    """
    from simbias.sweep import running

    return running.run(overrides, config_dir, observer, allow)


def identify(
    recordings: Sequence[Path | str],
    overrides: Sequence[str],
    held_out: Sequence[Path | str] = (),
    columns: Mapping[str, str] | None = None,
    config_dir: Path | str | None = None,
    allow: Sequence[str] = (),
) -> Assessment:
    """Identify a model from recordings (CSV files or folders of them), and assess it on held-out recordings.

    >>> found = identify(["recordings"], ["preset=double_pendulum", "identification=posterior"])
    >>> found.better, [finding.trusted for finding in found.findings]

    `columns` maps the task's names to names of columns. A held-out file is never used for fitting, even if
    `recordings` also names it or a copy of it. Warnings report how the data were changed.

    Raises
    ------
    simbias.config.ConfigError
        If an override is bad, nothing is identified, or the recordings are unreadable or too short.
    """
    from simbias.config import compose
    from simbias.config.build import NOT_OF_RECORDINGS, build
    from simbias.recordings.assessment import assess, prepared
    from simbias.recordings.fitting import LONGEST
    from simbias.recordings.reading import read_apart

    composition = compose(overrides, config_dir, allow, NOT_OF_RECORDINGS)
    study = prepared(build(composition, NOT_OF_RECORDINGS))
    fitted, kept = read_apart(study, recordings, held_out, columns, LONGEST)
    for note in (*fitted.notes, *kept.notes):
        warnings.warn(note, stacklevel=2)
    return assess(study, fitted.rollouts, kept.rollouts, doubt=fitted.doubt)
