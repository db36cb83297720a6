"""Where things are kept that take long to make and may be deleted at any time."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path


def cache_folder(name: str, *first: str) -> Path:
    """A folder that can be written: in one of the `first`, in the package, or in the user's cache.

    Raises
    ------
    OSError
        If there is none.
    """
    here = Path(__file__).parent / "__pycache__"
    users = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "simbias"
    for parent in (*map(Path, first), here, users, Path(tempfile.gettempdir())):
        folder = parent / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    raise OSError(f"there is no folder for {name} that can be written; XDG_CACHE_HOME names one")
