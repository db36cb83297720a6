"""The user's own code in a trial: digests of modules, kept with the trial but not part of its identity.

Editing a comment makes no other trial, so changes are reported, and the user judges whether results still
count.
"""

from __future__ import annotations

import ast
import logging
import sys
from collections.abc import Iterator, Mapping
from importlib.machinery import ModuleSpec
from importlib.util import resolve_name
from pathlib import Path
from typing import Any

from simbias.config.allowed import OWN, targets
from simbias.core.digest import short_digest

INSTALLED = ("site-packages", "dist-packages")  # folders of unrelated packages
EDITED = "simbias: %s was edited after Python had imported it; until Python restarts, the former code runs"
_seen: dict[str, tuple[ModuleSpec | None, set[str]]] = {}  # each module's spec and digests


def digests(config: Mapping[str, Any]) -> dict[str, str]:
    """Digests of the user's modules that define a config's components, and their packages' versions.

    Modules that these import also count, if they lie in the same package or folder; other installed packages
    do not. The components have been built, so their modules are loaded. A warning names a module whose file
    has changed since.
    """
    found: dict[str, str] = {}
    for target in targets({key: value for key, value in config.items() if isinstance(value, Mapping)}):
        module = str(target).rpartition(".")[0]
        if module.partition(".")[0] != OWN:
            for name, file in _with_imported(module):
                found[name] = short_digest(file.read_bytes())
                _tell_if_edited(name, found[name])
            version = getattr(sys.modules.get(module.partition(".")[0]), "__version__", None)
            if version is not None:
                found[f"{module.partition('.')[0]} version"] = str(version)
    return dict(sorted(found.items()))


def _tell_if_edited(module: str, digest: str) -> None:
    """Warn once if a module has another digest than when first seen; importlib.reload starts afresh."""
    spec = sys.modules[module].__spec__
    imported, known = _seen.get(module, (spec, set[str]()))
    known = known if imported is spec else set()
    if known and digest not in known:
        logging.getLogger(__name__).warning(EDITED, module)
    _seen[module] = spec, {*known, digest}


def _with_imported(module: str) -> Iterator[tuple[str, Path]]:
    """A module and the modules of the same home that it imports, directly or indirectly, with their files."""
    home, waiting, seen = _home(module), [module], set()
    while waiting:
        name = waiting.pop()
        file = _file(name)
        if name in seen or file is None or _home(name) != home or name.partition(".")[0] == OWN:
            continue
        seen.add(name)
        yield name, file
        waiting += _imports(name, file)


def _imports(module: str, file: Path) -> Iterator[str]:
    """The names imported in a module's text: modules, and possibly their members."""
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    try:
        tree = ast.parse(file.read_bytes())
    except SyntaxError:  # edited since its import
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = (
                resolve_name("." * node.level + (node.module or ""), package) if node.level else node.module
            )
            yield str(base)
            yield from (f"{base}.{alias.name}" for alias in node.names)


def _file(module: str) -> Path | None:
    """The file of a loaded module, if it is Python source."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file) if file and file.endswith(".py") else None


def _home(module: str) -> Path | None:
    """The folder that contains a module or its package."""
    file = _file(module.partition(".")[0])
    if file is None:
        return None
    folder = file.parent.parent if file.name == "__init__.py" else file.parent
    return file.parent if folder.name in INSTALLED else folder
