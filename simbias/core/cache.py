"""Folders for results that take long to make and may be deleted at any time."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path


def cache_folder(name: str, *first: str) -> Path:
    """A writable cache folder: in one of the `first`, in the package, or in the user's cache.

    OSError if none is writable.
    """
    for parent in _parents(first):
        folder = parent / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    raise OSError(f"no folder for {name} can be written; set XDG_CACHE_HOME to one")


def _parents(first: tuple[str, ...]) -> Iterator[Path]:
    """Possible parents of a cache folder, the best first."""
    yield from map(Path, first)
    yield Path(__file__).parent.parent / "__pycache__"
    with suppress(RuntimeError):  # a user without a home, as in some containers
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "simbias"
    yield _private()


def _private() -> Path:
    """The user's private temporary folder; OSError if another user owns a folder of that name.

    Privacy matters because Numba runs whatever it finds in its cache.
    """
    user = os.getuid() if sys.platform != "win32" else 0  # on Windows, temporary folders are per user
    folder = Path(tempfile.gettempdir()) / f"simbias-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if sys.platform != "win32" and (found.st_uid != user or found.st_mode & 0o022 or folder.is_symlink()):
        raise OSError(f"{folder} is another user's; set XDG_CACHE_HOME to a folder for compiled code")
    return folder
