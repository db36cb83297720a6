"""Kernels of components for compiled simulations, and the warning where a slower path is taken."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple


class Kernel(NamedTuple):
    """A component's function in the compiled closed loop: see `simbias.simulation.compiler.kernels`.

    Without one, its method is traced if it is ordinary vectorised NumPy.
    """

    function: Callable
    parameters: Any  # an array; of a bias that works on all lanes, a tuple of arrays


class SlowWarning(UserWarning):
    """A request works, but slowly; the message says how slowly, and what would be faster."""
