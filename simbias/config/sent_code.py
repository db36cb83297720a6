"""The user's own code and files, packed for workers on other machines."""

from __future__ import annotations

import io
import os
import sys
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from simbias.config.allowed import OWN, leaves
from simbias.config.composition import NOT_HASHED, Composition
from simbias.core.errors import ConfigError

MOST_BYTES = 64 * 2**20
ROOT = "root"  # stands for the name of /


def packed(compositions: Iterable[Composition]) -> bytes:
    """Pack folders of configs and needed files beside them: modules, loaded packages, files named in configs.

    The result is a zip file of the folder that contains them: once this folder is unpacked and in `sys.path`,
    `simbias.core.files.find` and imports find everything. Empty if there is nothing to send; a ConfigError if
    it exceeds 64 MiB.
    """
    files = {file: name for each in compositions for file, name in _needed(each)}
    if (size := sum(file.stat().st_size for file in files)) > MOST_BYTES:
        problem = f"{size / 2**20:.0f} MiB is too much to send to workers; let them share the disk"
        raise ConfigError("--config-dir", problem)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, strict_timestamps=False) as archive:
        for file, name in sorted(files.items()):
            archive.write(file, name)
    return stream.getvalue() if files else b""


def _needed(composition: Composition) -> Iterator[tuple[Path, str]]:
    """The files that a trial may need, each with its name in the zip file."""
    loaded = {name.partition(".")[0] for name in sys.modules} - {OWN}
    values = [value for path, value in leaves(composition.config) if not set(NOT_HASHED) & set(path)]
    for folder in map(Path, composition.own.folders):
        home = folder.parent
        named = {Path(text).parts[0] for text in values if isinstance(text, str) and _is_in(home, text)}
        for each in home.iterdir():
            package = each.is_dir() and each.name in loaded
            if each == folder or each.suffix == ".py" or package or each.name in named:
                yield from ((file, f"{home.name or ROOT}/{file.relative_to(home)}") for file in _files(each))


def _is_in(home: Path, name: str) -> bool:
    """Whether a text is the relative name of a file or folder in `home`."""
    path = Path(name)
    try:
        return bool(path.parts) and not {"..", path.anchor} & set(path.parts) and (home / path).exists()
    except (OSError, ValueError):  # not a valid file name
        return False


def _files(path: Path) -> Iterator[Path]:
    """A file, or those in a folder and below it that are neither hidden nor compiled."""
    if path.is_file():
        yield path
    for root, inner, names in os.walk(path):
        inner[:] = [name for name in inner if not name.startswith((".", "__pycache__"))]
        files = (Path(root, name) for name in names if not name.startswith("."))
        yield from filter(Path.is_file, files)  # no pipes or broken links
