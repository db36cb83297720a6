"""Report pages of trials' and sweeps' folders."""

from __future__ import annotations

import errno
import os
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
    alone = [folder] if (folder / TRIAL).is_file() or (folder / SWEEP).is_file() else []
    folders = alone or [sweep.path for sweep in sweep_folders(folder)]
    if not folders:
        raise ConfigError(str(folder), "is the folder of no trial or sweep, as trials/7a29f4c5425f")
    for own in folders:  # before minutes of drawing
        if not os.access(own, os.W_OK):
            raise ConfigError(str(own / FILE), f"cannot be written ({os.strerror(errno.EACCES)})")
    for own in folders:
        trial = (own / TRIAL).is_file()
        page = trial_page(own, config_dir, allow) if trial else sweep_page(SweepFolder(own))
        try:
            write_whole(own / FILE, page.encode())
        except OSError as error:
            raise ConfigError(str(own / FILE), f"cannot be written ({error.strerror})") from error
    return [own / FILE for own in folders]
