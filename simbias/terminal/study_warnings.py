"""Warnings about a study on a terminal; without Rich, as every command imports this first."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from simbias.core import StudyWarning


@contextmanager
def warnings_in_one_line() -> Iterator[None]:
    """Show each StudyWarning once, as one line, without its place in the code."""
    shown_otherwise = warnings.showwarning
    shown: set[str] = set()

    def show(message: Warning | str, *place: Any, **otherwise: Any) -> None:
        if not isinstance(message, StudyWarning):
            shown_otherwise(message, *place, **otherwise)
        elif str(message) not in shown:
            print(f"simbias: {message}", file=sys.stderr)
            shown.add(str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("always", StudyWarning)
        warnings.showwarning = show
        yield
