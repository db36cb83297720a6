"""Files that a config names: a relative one is looked for in the folder of configs and beside it."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, ValidationInfo

FOLDERS = "folders"  # of configs: what the validation of a constructor's arguments is told


def find(name: str, folders: Sequence[str]) -> str:
    """The file or folder of a relative name, absolute; the name itself where no folder of configs has it.

    The name is then relative to the working folder.
    """
    places = (place for folder in folders for place in _places(Path(folder)))
    found = (place / name for place in places if not Path(name).is_absolute())
    return str(next(filter(Path.exists, found), name))


def sought(name: str) -> str:
    """Where a file of a relative name was looked for in vain, in words that end a message on it."""
    if Path(name).is_absolute():
        return ""
    places = f"neither in {Path.cwd()} nor in a folder of configs or beside it"
    return f", {places}; give --config-dir (config_dir=) if the trial was run with it"


def _places(folder: Path) -> Iterator[Path]:
    """A folder of configs and the one that it lies in: here, or where a cluster's worker has its copy."""
    homes = [folder.parent] if folder.is_dir() else map(Path, sys.path)
    for home in homes:
        yield from (home / folder.name, home)


def _found(name: str, info: ValidationInfo) -> str:
    """The file of a name in a config; the name itself where no folders are known, as in an identity."""
    return find(name, (info.context or {}).get(FOLDERS, ()))


ConfigFile = Annotated[str, AfterValidator(_found)]
