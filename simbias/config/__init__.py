"""From overrides to a checked composition, and to components."""

from simbias.config.composition import Composition, Variations, compose, options, sweeps
from simbias.config.errors import ConfigError

__all__ = ["Composition", "ConfigError", "Variations", "compose", "options", "sweeps"]
