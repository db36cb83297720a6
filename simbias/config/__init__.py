"""From overrides to a checked composition, and on to components."""

from simbias.config.composition import Composition, Variations, compose
from simbias.config.resources import options, sweeps
from simbias.core.errors import ConfigError

__all__ = ["Composition", "ConfigError", "Variations", "compose", "options", "sweeps"]
