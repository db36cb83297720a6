"""A cache of Hydra's option files: parsing them again would take a third of a composition's time."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin

from simbias.config.hydra_config import copies
from simbias.config.resources import check_ends, resource_folder

SCHEME = "simbias"
_SOURCES: list[Any] = Plugins.instance().discover(ConfigSource)
_Files: Any = next(each for each in _SOURCES if each.scheme() == "file")


class OptionFiles(_Files):
    """A folder of options: the shipped ones, or a user's."""

    @staticmethod
    def scheme() -> str:
        """The scheme of such a folder in Hydra's search path."""
        return SCHEME

    def load_config(self, config_path: str) -> ConfigResult:
        """A copy of a file's content, as Hydra modifies it; read again once the file has changed."""
        about = os.stat(os.path.join(self.path, f"{config_path.removesuffix('.yaml')}.yaml"))
        read = _read(self.provider, self.path, config_path, about.st_mtime_ns, about.st_size)
        result: ConfigResult = read()
        return result


class ShippedOptions(SearchPathPlugin):
    """Search only simbias's own folder of options with `OptionFiles`, not other programs' folders."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Replace the folder in Hydra's search path."""
        for each in search_path.get_path():
            if each.path == str(resource_folder("conf")):
                each.path = f"{SCHEME}://{each.path}"


@lru_cache(maxsize=1000)
def _read(provider: str, folder: str, config_path: str, time: int, size: int) -> Callable[[], Any]:
    """A file's content as Hydra reads it."""
    check_ends(Path(folder, f"{config_path.removesuffix('.yaml')}.yaml"))
    return copies(_Files(provider, f"file://{folder}").load_config(config_path))


@cache
def register() -> None:
    """Register both with Hydra."""
    for each in (OptionFiles, ShippedOptions):
        Plugins.instance().register(each)
