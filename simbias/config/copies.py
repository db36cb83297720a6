"""Copies of Hydra's mutable results, several times faster than OmegaConf's own."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import partial
from typing import Any


def copies(original: object) -> Callable[[], Any]:
    """A function that makes copies of an object on demand; they never leave the process."""
    return partial(pickle.loads, pickle.dumps(original))
