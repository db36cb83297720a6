"""What a component offers to compiled simulations, and what is said where it offers nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple


class Kernel(NamedTuple):
    """What a component offers to the compiled closed loop: see `simbias.simulation.compiler.kernels`.

    Without one, its method is traced if it is ordinary vectorised NumPy.
    """

    function: Callable
    parameters: Any  # an array; of a bias that works on all lanes, a tuple of arrays


class SlowWarning(UserWarning):
    """What was asked for works, but slowly; the message says how slowly, and what would be faster."""
