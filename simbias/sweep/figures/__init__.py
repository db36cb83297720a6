"""Figures of sweeps; figures of a single shipped sweep lie beside it, in `sweeps/figures/`."""

from simbias.config.resources import resource_folder

__path__.append(str(resource_folder("sweeps") / "figures"))
