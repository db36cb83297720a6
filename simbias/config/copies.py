"""Copies of what Hydra makes and changes, several times as fast as OmegaConf's own."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import partial
from typing import Any


def copies(original: object) -> Callable[[], Any]:
    """A function that makes copies of an object, as many as asked for; they never leave the process."""
    return partial(pickle.loads, pickle.dumps(original))
