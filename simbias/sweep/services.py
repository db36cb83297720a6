"""From a composition to what a study runs with: an engine and a store."""

from __future__ import annotations

from typing import Any

from simbias.config.components import construct
from simbias.config.composition import Composition
from simbias.core.errors import ConfigError
from simbias.engine.contract import Engine
from simbias.sweep.tracking import Tracking


def engine(composition: Composition) -> Engine:
    """Construct where a sweep's trials run.

    Raises
    ------
    ConfigError
        As `build` does.
    """
    return construct(_group(composition, "engine"), Engine, "engine", composition.own)


def tracking(composition: Composition) -> Tracking:
    """Construct the store of a study's or a sweep's trials.

    Raises
    ------
    ConfigError
        As `build` does.
    """
    return construct(_group(composition, "tracking"), Tracking, "tracking", composition.own)


def _group(composition: Composition, group: str) -> Any:
    """The config of a group."""
    if group not in composition.config:
        raise ConfigError(group, "missing")
    return composition.config[group]
