"""The work of a sweep's worker: a composition in, a trial's summary out."""

from __future__ import annotations

import io
import time
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from errno import ENOSPC
from pathlib import Path
from shutil import disk_usage
from socket import gethostname
from tempfile import gettempdir
from typing import NamedTuple

from simbias.config import Composition
from simbias.config.build import build
from simbias.core import StudyWarning
from simbias.core.error_origin import has_own_code
from simbias.core.errors import ConfigError
from simbias.core.messages import quote, with_trace, with_type, words
from simbias.core.platform import package_digest
from simbias.engine.contract import WorkplaceError
from simbias.engine.workplace import temporary_folder
from simbias.trial.disk import write_whole
from simbias.trial.folder import ATTEMPTS, OUTCOME, TRIAL, TakenError, TrialFolder
from simbias.trial.origin import digests
from simbias.trial.run import TrialRecord, run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome, TrialSummary

OTHER_CODE = "code or files differ from those where the sweep was started ({})"
ROOM = 10_000_000  # bytes that must be free for a trial without a shared disk
GONE = "the folder {} is gone: was it moved while the sweep ran? Move it back, and start the sweep again"


class PlannedTrial(NamedTuple):
    """A trial to be run."""

    composition: Composition
    folder: str | None = None  # folder in which it is kept
    marker: str = ""  # a file beside it, visible only to workers that share the disk
    kept: bytes = b""  # the folder's content so far, for workers without the shared disk
    pictures: tuple[str, ...] = ()  # to draw at its end
    code: Mapping[str, str] | None = None  # digests to compare with the worker's; None: it shares the disk


class Result(NamedTuple):
    """A trial that ended or stopped."""

    summary: TrialSummary
    traceback: str = ""  # if no folder keeps it
    packed: bytes = b""  # its folder, from a worker without a shared disk


def run_plan(plan: PlannedTrial) -> Result:
    """Run or resume a trial; without a shared disk, in the worker's own folder, from the sent content.

    A cluster's worker raises a WorkplaceError if no trial can begin there: code or disk space is missing.
    """
    apart = bool(plan.marker) and not Path(plan.marker).exists()
    folder = None if plan.folder is None else Path(plan.folder)
    begun = plan.code is None  # otherwise the worker may be on another machine
    with warnings.catch_warnings(), ExitStack() as stack:
        warnings.simplefilter("ignore", StudyWarning)  # would print a line for each fit of each trial
        try:
            if folder is not None and apart:
                folder = Path(stack.enter_context(temporary_folder()), folder.name)
                if disk_usage(folder.parent).free < ROOM:
                    raise OSError(ENOSPC, f"less than {ROOM // 10**6} MB are free", gettempdir())
                if plan.kept:
                    unpack(plan.kept, folder)
            elif folder is not None and not folder.parent.exists():
                return lost(GONE.format(folder.parent))
            study = build(plan.composition)
            theirs = code(study) if plan.code else {}  # some may be loaded only there or here
            if other := [
                name for name, digest in (plan.code or {}).items() if theirs.get(name, digest) != digest
            ]:
                raise ConfigError("", OTHER_CODE.format(", ".join(other)))
            begun = True
            record = run_trial(study, folder)
            if folder is not None and plan.pictures:
                _illustrate(record, folder, plan.pictures)
            packed, summary = b"", record.summary
            if folder is not None and apart:
                packed = pack(folder)
                if summary.traceback_file:  # it will be where the folder is unpacked
                    there = Path(str(plan.folder), Path(summary.traceback_file).name)
                    summary = replace(summary, traceback_file=str(there))
        except KeyboardInterrupt:
            raise
        except TakenError as error:
            return Result(TrialSummary(Outcome.RUNNING, reason=str(error)))
        except BaseException as error:
            reason = with_type(error) + ("" if plan.code is None else _where(error))
            if not begun:
                raise WorkplaceError(reason) from error
            return lost(reason)._replace(traceback=with_trace(error) if has_own_code(error) else "")
    return Result(summary, "" if folder else record.traceback, packed)


def _illustrate(record: TrialRecord, folder: Path, names: Sequence[str]) -> None:
    """Draw a trial; after an error, such as a full disk, the next start of the sweep draws it."""
    from simbias.pictures.trial.gallery import illustrate  # lazily: most trials have none

    try:
        illustrate(record, folder, names)
    except Exception as error:
        warnings.warn(f"pictures of trial {folder.name}: {with_type(error)}", RuntimeWarning, stacklevel=2)


def _where(error: BaseException) -> str:
    """The machine and folder of a cluster's worker, and its module path."""
    modules = "" if isinstance(error, OSError) else "; its PYTHONPATH finds modules"
    return f" (on {gethostname()}, in {Path.cwd()}{modules})"


def code(study: Study) -> Mapping[str, str]:
    """Digests of simbias, and of the user's modules and files that a study uses."""
    return {"simbias": package_digest(), **digests(study)}


def lost(reason: str) -> Result:
    """The result of a trial that could not begin, or whose workers died; its folder keeps its progress."""
    return Result(TrialSummary(Outcome.ERROR, reason=reason, ended=time.time()))


def pack(folder: Path) -> bytes:
    """A trial's folder as a zip file, in the order of writing: trial.json first, its outcome last."""
    stream, files, last = io.BytesIO(), TrialFolder(folder).files(), Path(OUTCOME).stem
    try:
        with zipfile.ZipFile(stream, "w") as archive:
            for file in sorted(files, key=lambda file: (file.name.startswith(last), file.name != TRIAL)):
                archive.write(file, file.relative_to(folder).as_posix())
    except OSError as error:
        raise ConfigError(str(folder), f"cannot be read ({words(error)})") from error
    return stream.getvalue()


def goes_on(packed: bytes, folder: Path) -> bool:
    """Whether a worker's result continues the folder's content: each run or withdrawal adds a line."""
    file = folder / ATTEMPTS
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        sent = archive.read(ATTEMPTS) if ATTEMPTS in archive.namelist() else b""
    return sent.startswith(file.read_bytes() if file.exists() else b"")


def unpack(packed: bytes, folder: Path) -> None:
    """Unpack a transferred trial's folder, writing each file atomically."""
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        for name in archive.namelist():
            path = folder / name
            if not path.resolve().is_relative_to(folder.resolve()):
                raise ConfigError(str(folder), f"a worker sent {quote(name)}, which would lie outside")
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, archive.read(name))
