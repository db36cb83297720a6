"""Kernels of components for compiled simulations, and the warning about slower paths."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple


class Kernel(NamedTuple):
    """A component's function in the compiled closed loop: see `simbias.simulation.compiler.kernels`.

    Without a kernel, the component's method is traced if it is ordinary vectorised NumPy.
    """

    function: Callable
    parameters: Any  #: an array; for a bias that works on all lanes, a tuple of arrays
