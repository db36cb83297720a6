"""Files named in a config: relative paths are looked up in the folder of configs and beside it."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, ValidationInfo

FOLDERS = "folders"  # of configs: key in the context of the validation of a constructor's arguments


def find(name: str, folders: Sequence[str]) -> str:
    """The absolute path of a relative name; the name itself if no folder of configs holds it.

    The name is then relative to the working folder.
    """
    places = (place for folder in folders for place in _places(Path(folder)))
    found = (place / name for place in places if not Path(name).is_absolute())
    return str(next(filter(Path.exists, found), name))


def sought(name: str) -> str:
    """Where a file of a relative name was searched in vain, as the end of an error message."""
    if Path(name).is_absolute():
        return ""
    places = f"neither in {Path.cwd()} nor in a folder of configs or beside it"
    return f", {places}; give --config-dir (config_dir=) if the trial was run with it"


def _places(folder: Path) -> Iterator[Path]:
    """A folder of configs and its parent: here, or where a cluster's worker has its copy."""
    homes = [folder.parent] if folder.is_dir() else map(Path, sys.path)
    for home in homes:
        yield from (home / folder.name, home)


def _found(name: str, info: ValidationInfo) -> str:
    """The file of a name in a config; the name itself if no folders are known, as for an identity."""
    return find(name, (info.context or {}).get(FOLDERS, ()))


ConfigFile = Annotated[str, AfterValidator(_found)]
