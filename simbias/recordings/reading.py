"""Recordings from files and folders, in a task's frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from simbias.core import HardwareError
from simbias.core.errors import ConfigError
from simbias.core.messages import words
from simbias.core.records import Rollout
from simbias.lab.recorded import Recorded
from simbias.trial.study import Study


def read(
    study: Study, places: Sequence[Path | str], columns: Mapping[str, str] | None = None
) -> dict[str, Rollout]:
    """Recordings by name, of files and of all CSV files in folders.

    Without columns, those of the study's `hardware=recorded` are read, or else the task's own names.

    Raises
    ------
    ConfigError
        If there is no such file, or one cannot be read; the message is one line.
    """
    hardware = study.hardware
    if columns or not isinstance(hardware, Recorded):
        try:
            hardware = Recorded(study.task, ".", columns=columns)
        except ValueError as error:
            raise ConfigError("columns", words(error).removeprefix("columns ")) from error
    files = [file for place in places for file in _files(Path(place))]
    try:
        return {_name(file, files): hardware.read(file) for file in files}
    except HardwareError as error:
        raise ConfigError("", words(error)) from error


def columns(text: str) -> dict[str, str]:
    """Names of columns from YAML, or from a file of that.

    Raises
    ------
    ConfigError
        If it is no mapping of names.
    """
    import yaml

    try:
        found = yaml.safe_load(Path(text).read_text() if text.endswith((".yaml", ".yml")) else text)
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError("--columns", words(error)) from error
    if not isinstance(found, dict) or not all(
        isinstance(each, str) for pair in found.items() for each in pair
    ):
        raise ConfigError("--columns", "must be a mapping of names, as '{pos1: q1, vel1: dq1}'")
    return found


def _files(place: Path) -> list[Path]:
    """A file, or those of a folder."""
    found = sorted(place.glob("*.csv*")) if place.is_dir() else [place]
    if not found or not all(file.is_file() for file in found):
        raise ConfigError(str(place), "no such recording (.csv, .csv.gz)")
    return found


def _name(file: Path, files: Sequence[Path]) -> str:
    """A file's name, with its folder where several have the same."""
    return file.name if sum(other.name == file.name for other in files) == 1 else str(file)
