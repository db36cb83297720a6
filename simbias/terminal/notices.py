"""A notice on stderr about compilation."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from numba.core.event import Event, Listener, install_listener

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
