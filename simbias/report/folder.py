"""Report pages of trials' and sweeps' folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from simbias.core.errors import ConfigError
from simbias.report.sweep import sweep_page
from simbias.report.trial import trial_page
from simbias.sweep.folder import SWEEP, SweepFolder, sweep_folders
from simbias.trial.disk import write_whole
from simbias.trial.folder import TRIAL

FILE = "report.html"


def write_report(folder: Path, config_dir: Path | str | None = None, allow: Sequence[str] = ()) -> list[Path]:
    """Write `report.html` into a trial's or a sweep's folder, or into those of all sweeps beside trials.

    Raises
    ------
    ConfigError
        If the folder holds neither, or what it holds cannot be read or written.
    """
    if (folder / TRIAL).is_file():
        pages = {folder: trial_page(folder, config_dir, allow)}
    elif (folder / SWEEP).is_file():
        pages = {folder: sweep_page(SweepFolder(folder))}
    else:
        pages = {sweep.path: sweep_page(sweep) for sweep in sweep_folders(folder)}
    if not pages:
        raise ConfigError(str(folder), "is the folder of no trial or sweep, as trials/7a29f4c5425f")
    for own, page in pages.items():
        try:
            write_whole(own / FILE, page.encode())
        except OSError as error:
            raise ConfigError(str(own / FILE), f"cannot be written ({error.strerror})") from error
    return [own / FILE for own in pages]
