"""The work of a sweep's worker: a plain config in, a trial's summary out."""

from __future__ import annotations

import io
import time
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from simbias.config import Composition
from simbias.config.build import build
from simbias.core import SlowWarning
from simbias.core.messages import with_type
from simbias.trial.folder import TrialFolder
from simbias.trial.run import run_trial
from simbias.trial.summary import Outcome, TrialSummary


class Plan(NamedTuple):
    """A trial, in plain containers."""

    config: Mapping[str, Any]
    choices: Mapping[str, str]
    folder: str | None = None  # in which it is kept
    marker: str = ""  # a file beside it: seen only by workers that share the disk
    pictures: tuple[str, ...] = ()  # to draw at its end
    allowed: tuple[str, ...] = ()  # modules of which the config may name classes


class Result(NamedTuple):
    """A trial that ended or stopped."""

    summary: TrialSummary
    traceback: str = ""  # where no folder keeps it
    packed: bytes = b""  # its folder, of a worker that shares no disk


def run_plan(plan: Plan) -> Result:
    """Run or resume a trial."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SlowWarning)  # a line for each fit of each trial is too many
        folder = None if plan.folder is None else Path(plan.folder)
        try:
            study = build(Composition(plan.config, plan.choices, plan.allowed))
            record = run_trial(study, folder)
            if folder is not None and plan.pictures:
                from simbias.pictures.trial.gallery import illustrate  # lazily: most trials have none

                illustrate(record, folder, plan.pictures)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            return lost(with_type(error))
    apart = folder is not None and bool(plan.marker) and not Path(plan.marker).exists()
    return Result(record.summary, "" if folder else record.traceback, _pack(folder) if apart else b"")


def lost(reason: str) -> Result:
    """The result of a trial that could not begin, or whose workers died; its folder has what it did."""
    return Result(TrialSummary(Outcome.ERROR, reason=reason, started=time.time()))


def _pack(folder: Path | None) -> bytes:
    """A trial's folder as a zip file."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for file in TrialFolder(folder).files() if folder else ():
            archive.write(file, file.relative_to(folder or Path()).as_posix())
    return stream.getvalue()


def unpack(packed: bytes, folder: Path) -> None:
    """Lay out a trial's folder that travelled."""
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        archive.extractall(folder)
