"""The options of every group and the sweeps: shipped ones, and those in the user's folder."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

from simbias.config.renamed import unknown
from simbias.core.errors import ConfigError, reason
from simbias.trial.disk import require_file

PRIMARY = "config.yaml"  # the file that names the defaults
MAX_VALUES = 1_000_000  # of a YAML file, with expanded aliases


def resource_folder(folder: str) -> Path:
    """The folder `conf` or `sweeps`: inside an installed package, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / folder
    return inside if inside.is_dir() else package.parent / folder


def options(config_dir: Path | str | None = None) -> dict[str, list[str]]:
    """The options of every group, defaults first, including those in the user's folder."""
    from omegaconf import OmegaConf

    root = resource_folder("conf")
    folders = [root, *([Path(config_dir)] if config_dir is not None else [])]
    defaults = OmegaConf.load(root / PRIMARY).defaults
    chosen = {group: option for entry in defaults if entry != "_self_" for group, option in entry.items()}
    return {
        group: [option, *sorted(_names(folder / group for folder in folders) - {option})]
        for group, option in chosen.items()
    }


def sweeps(config_dir: Path | str | None = None) -> list[str]:
    """The shipped sweeps, and those in the user's folder."""
    return sorted(_names(_sweep_folders(config_dir)))


def _names(folders: Iterator[Path]) -> set[str]:
    """The names of the configs in some folders."""
    there = filter(os.path.isdir, folders)  # also False for invalid file names
    return {file.stem for folder in there for file in folder.glob("*.yaml")}


def _sweep_folders(config_dir: Path | str | None) -> Iterator[Path]:
    """The folders of sweeps, the user's first."""
    if config_dir is not None:
        yield Path(config_dir) / "sweeps"
    yield resource_folder("sweeps")


def register_sweep(
    name: str, config_dir: Path | str | None, grid: bool, known: frozenset[str] = frozenset()
) -> None:
    """Register a file of `sweeps`, and the files in its defaults list, as options of Hydra's group `sweep`.

    A search path would make the folder a group named `sweeps`, and require a package header in each file.
    Without the grid, their node `sweep` is left out. A ConfigError names a file that is missing or
    unreadable.
    """
    from hydra.core.config_store import ConfigStore

    found = (folder / f"{name}.yaml" for folder in _sweep_folders(config_dir))
    file = next((file for file in found if file.exists()), None)
    if file is None:
        choice = f"sweep={name}"
        names = ", ".join(sweeps(config_dir))
        raise unknown([choice], choice, f"no such option; sweep has {names}")
    try:
        about = file.stat()
        content = _loaded(file, about.st_mtime_ns, about.st_size)
    except ConfigError:
        raise
    except Exception as error:  # OmegaConf's, YAML's or the system's
        raise ConfigError(str(file), reason(error)) from error
    if not isinstance(content, dict):
        raise ConfigError(str(file), "must be a mapping")
    node = {key: value for key, value in content.items() if grid or key != "sweep"}
    ConfigStore.instance().store(name, node, "sweep", "_global_")
    for other in content.get("defaults") or []:
        if isinstance(other, str) and other not in {"_self_", name, *known}:
            register_sweep(other, config_dir, grid, known | {name})


def forget_sweeps() -> None:
    """Remove all sweeps from Hydra's options, which it copies for each composition."""
    from hydra.core.config_store import ConfigStore

    ConfigStore.instance().repo.pop("sweep", None)


@lru_cache(maxsize=100)
def _loaded(file: Path, time: int, size: int) -> Any:
    """The content of a YAML file in plain containers; it is read again once its time or size changes."""
    from omegaconf import OmegaConf

    check_ends(file)
    return OmegaConf.to_container(OmegaConf.load(file))


def state(folders: Sequence[Path]) -> frozenset[tuple[str, int, int]]:
    """Name, time and size of every shipped sweep and of every YAML file in these folders and below them.

    A changed state requires another composition. Hidden folders, such as environments, are skipped.
    """
    walks = [*map(os.walk, folders), islice(os.walk(resource_folder("sweeps")), 1)]
    return frozenset(entry for walk in walks for entry in _files(walk))


def _files(walk: Iterator[tuple[str, list[str], list[str]]]) -> Iterator[tuple[str, int, int]]:
    """The YAML files of a walk."""
    for root, inner, names in walk:
        inner[:] = [name for name in inner if not name.startswith(".")]
        for name in names:
            if name.endswith(".yaml"):
                with suppress(OSError):  # a broken link
                    about = os.stat(path := os.path.join(root, name))
                    yield path, about.st_mtime_ns, about.st_size


def check_ends(file: Path) -> None:
    """Refuse a pipe, a device, or a file whose nested aliases expand to too many values.

    OmegaConf expands aliases, and eleven lines may become 43 million values. A ConfigError names the file;
    invalid YAML is reported where the file is used.
    """
    import yaml  # lazily: --help needs none

    def size(node: yaml.Node) -> int:
        if id(node) not in sizes:
            sizes[id(node)] = 0  # for a node within itself, which OmegaConf refuses
            parts = node.value if isinstance(node, yaml.CollectionNode) else []
            nodes = [each for part in parts for each in (part if isinstance(part, tuple) else [part])]
            sizes[id(node)] = 1 + sum(map(size, nodes))
        return sizes[id(node)]

    sizes: dict[int, int] = {}
    require_file(file)
    try:
        text = file.read_bytes()
        values = size(yaml.compose(text, yaml.SafeLoader)) if b"&" in text else 0
    except Exception:  # YAML's or the system's
        return
    if values > MAX_VALUES:
        raise ConfigError(str(file), f"its aliases expand to {values:.0e} values; write out what is needed")


def check_no_primary(config_dir: Path) -> None:
    """Refuse a folder with a `config.yaml`, which would be ignored; a ConfigError names the alternative."""
    primary = config_dir / PRIMARY
    if primary.exists() and config_dir.resolve() != resource_folder("conf").resolve():
        raise ConfigError(
            str(primary), "is not read; move its choices to preset/NAME.yaml, and add preset=NAME"
        )
