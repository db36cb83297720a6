"""The options of every group and the sweeps: those that are shipped, and those of the user's folder."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simbias.config.files import check_file
from simbias.core.errors import ConfigError, reason

if TYPE_CHECKING:
    from hydra.core.config_store import ConfigNode

PRIMARY = "config.yaml"  # the one that names the defaults


def resource_folder(folder: str) -> Path:
    """The folder `conf` or `sweeps`: inside an installed package, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / folder
    return inside if inside.is_dir() else package.parent / folder


def options(config_dir: Path | str | None = None) -> dict[str, list[str]]:
    """The options of every group, defaults first; those of the user's folder too."""
    from omegaconf import OmegaConf

    root = resource_folder("conf")
    own = Path(config_dir) if config_dir is not None else root
    defaults = OmegaConf.load(root / PRIMARY).defaults
    chosen = {group: option for entry in defaults if entry != "_self_" for group, option in entry.items()}
    return {
        group: [
            option,
            *sorted({f.stem for folder in (root, own) for f in _files(folder / group)} - {option}),
        ]
        for group, option in chosen.items()
    }


def sweeps(config_dir: Path | str | None = None) -> list[str]:
    """The sweeps that are shipped, and those of the user's folder."""
    folders = [resource_folder("sweeps"), *([Path(config_dir) / "sweeps"] if config_dir is not None else [])]
    return sorted({file.stem for folder in folders for file in _files(folder)})


def _files(folder: Path) -> list[Path]:
    """The configs of a folder by name, but for what is no file, or has a name that cannot be written."""
    return sorted(file for file in folder.glob("*.yaml") if file.is_file() and file.stem.isprintable())


def register_sweeps(config_dir: Path | str | None, wanted: Any) -> None:
    """Make the files of `sweeps` options of Hydra's group `sweep`; those of `config_dir` come first.

    A file that cannot be read is passed over, unless it is the wanted one.
    """
    from hydra.core.config_store import ConfigStore

    group: dict[str, Any] = {}
    for folder in (resource_folder("sweeps"), *([Path(config_dir) / "sweeps"] if config_dir else [])):
        for file in _files(folder):
            try:
                about = file.stat()
                group[file.name] = _sweep(file, about.st_mtime_ns, about.st_size)
            except Exception as error:  # OmegaConf's, YAML's or the system's
                if file.stem != wanted:
                    continue
                if isinstance(error, ConfigError):
                    raise
                raise ConfigError(str(file), reason(error)) from error
    ConfigStore.instance().repo["sweep"] = group  # in place of those of another config_dir


@cache
def _sweep(file: Path, time: int, size: int) -> ConfigNode:
    """What is in a file that was changed last at that time; Hydra copies what it uses of it."""
    from hydra.core.config_store import ConfigNode
    from omegaconf import DictConfig, OmegaConf

    check_file(file)
    node = OmegaConf.load(file)
    if not isinstance(node, DictConfig):
        raise ConfigError(str(file), "must be a mapping")
    return ConfigNode(file.name, node, group="sweep", package="_global_", provider=None)


def check_no_primary(config_dir: Path | str | None) -> None:
    """Refuse a folder whose `config.yaml` would be passed over in silence.

    Raises
    ------
    ConfigError
        Naming the file, and what takes its place.
    """
    if config_dir is None or Path(config_dir).resolve() == resource_folder("conf").resolve():
        return
    primary = Path(config_dir) / PRIMARY
    if primary.exists():
        raise ConfigError(
            str(primary), "is not read; what it chooses belongs in preset/NAME.yaml, chosen by preset=NAME"
        )
