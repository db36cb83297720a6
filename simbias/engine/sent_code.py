"""The user's own code and files on the workers of a cluster, which may run several sweeps."""

from __future__ import annotations

import io
import sys
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import uuid4

from distributed import WorkerPlugin

from simbias.core.digest import short_digest
from simbias.engine.contract import WorkplaceError

PREFIX = "own-"  # of folders of sent code in a worker's own folder, followed by a digest


class SentCode(WorkerPlugin):
    """Unpacks a sweep's zip file, which holds one folder, on every worker, including later ones."""

    def __init__(self, packed: bytes) -> None:
        self.name = f"simbias-own-code-{uuid4().hex}"  # a plugin per sweep, even if their code is equal
        self._packed = packed
        with zipfile.ZipFile(io.BytesIO(packed)) as archive:
            folder = archive.namelist()[0].partition("/")[0]
        self.home = f"{PREFIX}{short_digest(packed)}/{folder}"  # where it is in a worker's own folder

    def setup(self, worker: Any) -> None:
        """Unpack it, unless a sweep with equal code has done so; its tasks may be reading the files."""
        folder = Path(worker.local_directory, self.home).parent
        if not folder.exists():
            with TemporaryDirectory(dir=worker.local_directory) as temporary:
                whole = Path(temporary, "whole")
                with zipfile.ZipFile(io.BytesIO(self._packed)) as archive:
                    archive.extractall(whole)
                whole.rename(folder)
        self._packed = b""  # may be large, and workers keep plugins


def use(home: str, worker: Any) -> None:
    """Put one sweep's folder first in Python's path, and drop that of another, with its modules.

    `home` is "" for a sweep without code. A WorkplaceError says that the folder is missing on this worker.
    """
    places = [Path(worker.local_directory, home)] if home else []
    former = [Path(path) for path in sys.path if path.startswith(str(Path(worker.local_directory, PREFIX)))]
    if not all(place.is_dir() for place in places):
        raise WorkplaceError("the code of this sweep is missing there")
    if places == former:
        return
    sys.path[:] = [*map(str, places), *(path for path in sys.path if Path(path) not in former)]
    names = {path.name.removesuffix(".py") for place in (*former, *places) for path in place.glob("*")}
    for module in [name for name in sys.modules if name.partition(".")[0] in names]:
        del sys.modules[module]
