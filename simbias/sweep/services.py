"""From a composition to what a study runs with: an engine and a store. Errors as of `build`."""

from __future__ import annotations

from typing import Any

from simbias.config.components import construct
from simbias.config.composition import Composition
from simbias.core.errors import ConfigError
from simbias.engine.contract import Engine
from simbias.sweep.tracking import Tracking


def engine(composition: Composition) -> Engine:
    """Construct where a sweep's trials run."""
    return _service(composition, "engine", Engine)


def tracking(composition: Composition) -> Tracking:
    """Construct the store of a study's or a sweep's trials."""
    return _service(composition, "tracking", Tracking)


def _service(composition: Composition, group: str, contract: type) -> Any:
    """Construct what a group names."""
    if group not in composition.config:
        raise ConfigError(group, "missing")
    return construct(composition.config[group], contract, group, composition.own)
