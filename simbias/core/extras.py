"""Libraries that may be missing, or log too much."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from simbias.core.messages import words


def library(module: str, name: str, extra: str) -> Any:
    """Import a module; if it is missing, a ValueError says how to install it."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ValueError(
            f"{name} is not installed ({words(error)}): pip install 'simbias[{extra}]'"
        ) from error


@contextmanager
def silent(name: str) -> Iterator[None]:
    """Silence the logger of this name within the context."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)
