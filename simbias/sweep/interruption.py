"""Being interrupted, but never in the middle of writing."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """Turns SIGINT and SIGTERM into KeyboardInterrupt, later where that would tear something apart.

    Without a handler SIGTERM ends a process without its `finally`, and leaves workers behind.
    """

    def __init__(self) -> None:
        self._deferring = False
        self._pending = False
        self._before: list = []

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():  # no other hears of signals
            self._before = [signal.signal(number, self._handle) for number in SIGNALS]
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in zip(SIGNALS, self._before, strict=False):
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        """Interrupt now, or note it for later."""
        if self._deferring:
            self._pending = True
        else:
            raise KeyboardInterrupt

    @contextmanager
    def defer(self) -> Iterator[None]:
        """Inside, nothing is interrupted; what came meanwhile interrupts at the end."""
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
        if self._pending:
            self._pending = False
            raise KeyboardInterrupt
