"""Learn the bias between a simulation and the hardware; optimise policies with few hardware experiments."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pandas import DataFrame

    from simbias.core.errors import ConfigError
    from simbias.core.records import Rollout
    from simbias.recordings.assessment import Assessment
    from simbias.sweep.running import SweepObserver
    from simbias.trial.observer import Observer
    from simbias.trial.run import TrialRecord
    from simbias.trial.study import Study

__version__ = "0.1.0"
__all__ = [
    "Assessment",
    "ConfigError",
    "Rollout",
    "Study",
    "TrialRecord",
    "identify",
    "load",
    "load_trial",
    "run_sweep",
    "run_trial",
]
_PLACES = {
    "Assessment": "simbias.recordings.assessment",
    "ConfigError": "simbias.core.errors",
    "Rollout": "simbias.core.records",
    "Study": "simbias.trial.study",
    "TrialRecord": "simbias.trial.run",
}


if not TYPE_CHECKING:  # type checkers would take any name for one of these

    def __getattr__(name: str) -> Any:
        """A class by its name; imported lazily, as the command line's --help needs none."""
        if name not in _PLACES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    """All names, also those imported lazily."""
    return sorted({*globals(), *__all__})


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


def run_trial(
    study: Study, folder: Path | str | None = None, observer: Observer | None = None
) -> TrialRecord:
    """Run a study's trial, resume it where it stopped, or replay it if it has ended.

    >>> trial = run_trial(load(["seed=3"]), "trials/mine")

    As on the command line, the user's own components are checked first. Steps in the folder are not repeated.
    Without a folder, nothing is kept. A folder keeps the study's config: a study that was changed otherwise,
    such as by `dataclasses.replace`, needs a folder of its own, and is read back without the change. An error
    of the hardware ends the trial: the record's `summary` tells it.

    Raises
    ------
    simbias.config.ConfigError
        If a component breaks its contract, the method cannot work with one, or the folder cannot be used.
    KeyboardInterrupt
        When interrupted; completed steps are kept.
    """
    from simbias.core import StudyWarning
    from simbias.core.errors import ConfigError
    from simbias.testing.rehearsal import rehearse
    from simbias.trial import run
    from simbias.trial.study import Study

    if not isinstance(study, Study):
        raise ConfigError("study", f"expected one, as simbias.load gives it, got {type(study).__name__}")
    if folder is not None and not study.as_composed:
        words = f"{folder} keeps only the config: components replaced in Python are not read back from there"
        warnings.warn(words, StudyWarning, stacklevel=2)
    rehearse(study)
    return run.run_trial(study, None if folder is None else Path(folder), observer)


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
    from simbias.mlflow.trial import trial_folder  # lazily: MLflow takes seconds

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

    `columns` maps the task's names, and `time`, to names of columns with their units, such as `"q1 [deg]"`.
    `identification=posterior` is chosen if neither an override nor a preset chooses a posterior. A held-out
    file is never used for fitting, even if `recordings` also names it or a copy of it. Warnings report how
    the data were changed.

    Raises
    ------
    simbias.config.ConfigError
        If an override is bad, nothing is identified, or the recordings are unreadable or too short.
    """
    from simbias.core.errors import check_list
    from simbias.recordings.assessment import assess
    from simbias.recordings.fitting import LONGEST
    from simbias.recordings.reading import read_apart
    from simbias.recordings.study import study_of

    for name, paths in (("recordings", recordings), ("held_out", held_out)):
        check_list(name, paths, (str, Path), "files and folders")
    study = study_of(overrides, config_dir, allow)
    fitted, kept = read_apart(study, recordings, held_out, columns, LONGEST)
    for note in (*fitted.notes, *kept.notes):
        warnings.warn(note, stacklevel=2)
    return assess(study, fitted.rollouts, kept.rollouts, doubt=fitted.doubt)
