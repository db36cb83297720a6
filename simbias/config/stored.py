"""Reading back a trial from its folder: its study is rebuilt, and its method replayed."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from simbias.config.allowed import own, prefixes
from simbias.config.build import build
from simbias.config.composition import Composition
from simbias.core.errors import ConfigError
from simbias.core.messages import with_type
from simbias.trial.folder import TRIAL, TrialFolder
from simbias.trial.origin import changed_code
from simbias.trial.run import TrialRecord, read_trial

OTHER_CONFIG = (
    "its config is that of trial {}, not of {}: the file has been changed, or another version of simbias "
    "ran the trial. Restore the file, or read the trial with that version"
)
CHANGED = "simbias: trial %s: its code or files have changed since it began (%s); results may differ"


def read_folder(folder: Path, config_dir: Path | str | None = None, allow: Sequence[str] = ()) -> TrialRecord:
    """The study and the full record of a trial's folder; the trial may still be running.

    A folder may be somebody else's: custom components must be importable, and lie beside `config_dir` or in a
    module that `allow` names. A warning names the user's modules and files that have changed since.

    Raises
    ------
    ConfigError
        If the folder is not a trial's, or something in it is unreadable or inconsistent.
    """
    description = TrialFolder(folder).description()
    folders = [] if config_dir is None else [Path(config_dir)]
    try:
        config, choices = description["config"], description["choices"]
        composition = Composition(config, choices, own(config, folders, prefixes(folders, allow)))
        study = build(composition)
        if study.hash != description["hash"]:
            raise ConfigError(str(folder / TRIAL), OTHER_CONFIG.format(study.hash, description["hash"]))
        changed = changed_code(TrialFolder(folder), study)
        if changed:
            logging.getLogger(__name__).warning(CHANGED, study.hash, changed)
        return replace(read_trial(study, folder), changed_code=changed)
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(str(folder / TRIAL), f"cannot be read ({with_type(error)})") from error
