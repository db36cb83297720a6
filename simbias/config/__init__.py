"""From overrides to a checked composition, and to components."""

from simbias.config.composition import Composition, Variations, compose
from simbias.config.errors import ConfigError
from simbias.config.resources import options, sweeps

__all__ = ["Composition", "ConfigError", "Variations", "compose", "options", "sweeps"]
