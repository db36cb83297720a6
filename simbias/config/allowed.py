"""Modules that a config may name: `_target_` imports its module, and imported code may do anything.

A config may come from somebody else. Besides simbias's own modules, it may therefore name only modules in, or
directly beside, a folder of configs named by the user (`--config-dir`), and modules with a prefix that the
user allowed, by `--allow` or by `allow` in that folder's `components.yaml`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib import invalidate_caches
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from simbias.core.errors import ConfigError
from simbias.core.messages import quote, words

OWN = "simbias"
FILE = "components.yaml"  # in a folder of configs: `allow: [my_robot]`
TARGET = "_target_"  # the key that names a component's class


class Own(NamedTuple):
    """The user's own code and files that a config may name."""

    modules: tuple[str, ...] = ()  # modules whose classes it may name
    folders: tuple[str, ...] = ()  # of configs, absolute


NOTHING = Own()


def check_allowed(module: str, key: str, allowed: Sequence[str]) -> None:
    """Refuse a module that is neither simbias's nor has an allowed prefix, by a ConfigError on the key."""
    if not any(module == prefix or module.startswith(f"{prefix}.") for prefix in (OWN, *allowed)):
        top = module.partition(".")[0]
        raise ConfigError(
            key,
            f"{quote(module)} is not imported: it is neither simbias's nor beside a folder of configs. "
            f"Name that folder by --config-dir or, if you trust the module, add --allow {top} (in Python, "
            f"config_dir=..., or allow=[{top!r}])",
        )


def prefixes(folders: Sequence[Path], allow: Sequence[str]) -> tuple[str, ...]:
    """The prefixes allowed by the user, and by the folders' `components.yaml`.

    A ConfigError names an invalid module name or an invalid file.
    """
    found = [_module(name, "--allow") for name in allow]
    for folder in folders:
        found += _of_file(folder / FILE)
    return tuple(dict.fromkeys(found))


def _of_file(file: Path) -> list[str]:
    """The prefixes that a folder's file allows; none if there is no file."""
    if not file.is_file():
        return []
    import yaml  # lazily: --help does not need it

    try:
        content: Any = yaml.safe_load(file.read_text(encoding="utf-8"))
    except Exception as error:  # YAML's or the system's
        raise ConfigError(str(file), words(error)) from error
    if (
        not isinstance(content, Mapping)
        or content.keys() != {"allow"}
        or not isinstance(content["allow"], list)
    ):  # its content is not shown: nested aliases may expand beyond the memory
        got = f"the keys {quote(list(content))}" if isinstance(content, Mapping) else type(content).__name__
        raise ConfigError(str(file), f"must be `allow: [module, ...]`, got {got}")
    return [_module(name, f"{file}: allow") for name in content["allow"]]


def _module(name: Any, key: str) -> str:
    """A module's dotted name, checked."""
    if not isinstance(name, str) or not all(part.isidentifier() for part in name.split(".")):
        raise ConfigError(key, f"must be the name of a module, such as my_robot, got {quote(name)}")
    return name


def own(config: Any, folders: Sequence[Path], prefixes: Sequence[str]) -> Own:
    """The modules that a config may name: with the prefixes, and those in or beside a folder of configs.

    Subfolders are not searched, as an environment with installed packages may lie there. The folders are
    appended to Python's module path. A ConfigError names a module there that Python imports from elsewhere.
    """
    homes = [home for folder in folders for home in (folder.resolve(), folder.absolute().parent.resolve())]
    sys.path += [path for path in dict.fromkeys(map(str, homes)) if path not in sys.path]
    for module in sorted({str(target).rpartition(".")[0] for target in targets(config)}):
        if module.partition(".")[0] != OWN:  # a folder of configs may lie in another checkout of simbias
            _check_not_hidden(module, homes)
    names = {str(target).partition(".")[0] for target in targets(config)} - {OWN}
    beside = sorted(name for name in names if homes and _homes(name) and _homes(name) <= {*homes})
    return Own((*prefixes, *beside), tuple(str(folder.absolute()) for folder in folders))


def targets(config: Any) -> Iterator[Any]:
    """The class names anywhere in a config."""
    return (value for path, value in leaves(config) if path[-1:] == (TARGET,))


def leaves(config: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """The values in nested mappings and lists, each with the path of keys and indices that leads to it."""
    if isinstance(config, Mapping | list):
        for key, value in config.items() if isinstance(config, Mapping) else enumerate(config):
            yield from leaves(value, (*path, key))
    else:
        yield path, config


def _check_not_hidden(module: str, homes: Sequence[Path]) -> None:
    """Refuse a module that lies in one of the folders if Python imports another of the same name.

    A copy with the same lines, such as an installed one, is allowed.
    """
    imported = _file(module)
    for home in homes:
        file = _file(module, [str(home)])
        if imported and file and file != imported and _lines(file) != _lines(imported):
            raise ConfigError(
                str(file), f"Python imports {quote(module)} from {imported} instead; rename one of them"
            )


def _lines(file: Path) -> list[bytes]:
    """A file's lines, without their ends, which Git may change."""
    return file.read_bytes().splitlines()


def _file(module: str, path: Sequence[str] | None = None) -> Path | None:
    """A module's file on a path, by default where Python finds it; its packages are not imported."""
    name, *parts = module.split(".")
    spec = _spec(name) if path is None else PathFinder.find_spec(name, path)
    for part in parts:
        inside = spec.submodule_search_locations if spec else None
        spec = PathFinder.find_spec(f"{name}.{part}", list(inside)) if inside else None
    return Path(spec.origin).resolve() if spec and spec.has_location and spec.origin else None


def _homes(name: str) -> set[Path]:
    """The folders in which a module or package lies, by its name without dots; it is not imported."""
    spec = _spec(name)
    if spec is None:
        return set()
    files = spec.submodule_search_locations or ([spec.origin] if spec.has_location and spec.origin else [])
    return {Path(file).parent.resolve() for file in files}


def _spec(name: str) -> ModuleSpec | None:
    """Where Python finds a module, by its name without dots; None if it finds none."""
    if not name.isidentifier():
        return None
    invalidate_caches()  # a notebook may have written it a moment ago
    try:
        return find_spec(name)
    except (ImportError, ValueError):  # for example, for __main__
        return None
