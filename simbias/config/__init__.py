"""From overrides to a checked composition, and to components."""

from simbias.config.composition import Composition, ConfigError, Variations, compose, options, sweeps

__all__ = ["Composition", "ConfigError", "Variations", "compose", "options", "sweeps"]
