"""The user's own code and files on the workers of a cluster."""

from __future__ import annotations

import io
import sys
import zipfile
from pathlib import Path
from typing import Any

from distributed import WorkerPlugin

from simbias.core.digest import short_digest


class SentCode(WorkerPlugin):
    """Unpacks a zip file into the module path of every worker, including later ones."""

    name = "simbias-own-code"  # the next one replaces it

    def __init__(self, packed: bytes) -> None:
        self._packed = packed

    def setup(self, worker: Any) -> None:
        """Unpack it in the worker's folder; modules of an earlier version are imported again."""
        folder = Path(worker.local_directory, f"own-{short_digest(self._packed)}")
        with zipfile.ZipFile(io.BytesIO(self._packed)) as archive:
            archive.extractall(folder)
            sent = {Path(name).parts[0].removesuffix(".py") for name in archive.namelist()}
        sys.path.insert(0, str(folder))
        for module in [name for name in sys.modules if name.partition(".")[0] in sent]:
            del sys.modules[module]
