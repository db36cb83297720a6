"""Notices on stderr: about compilation, and warnings."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core.event import Event, Listener, install_listener

from simbias.core import StudyWarning

COMPILING = "Compiling the simulation for this machine; later runs load it from the cache ..."


class _Announcer(Listener):
    """Reports once that something is being compiled."""

    def __init__(self) -> None:
        self._announced = False

    def on_start(self, event: Event) -> None:
        """A compilation begins."""
        if not self._announced:
            print(COMPILING, file=sys.stderr, flush=True)
        self._announced = True

    def on_end(self, event: Event) -> None:
        """A compilation has ended."""


@contextmanager
def preparing() -> Iterator[None]:
    """Report if something is compiled within the context, not loaded from the cache."""
    with install_listener("numba:compile", _Announcer()):
        yield


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
