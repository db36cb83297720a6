"""Libraries that come with an extra of simbias, imported where they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from simbias.core.messages import words


def library(module: str, name: str, extra: str) -> Any:
    """A module, which may be missing.

    Raises
    ------
    ValueError
        If it cannot be imported; the line says how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ValueError(
            f"{name} is not installed ({words(error)}): pip install 'simbias[{extra}]'"
        ) from error
