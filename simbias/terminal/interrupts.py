"""Ctrl-C, where Python would lose it, or be torn apart."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from numba.core.event import Event, Listener, install_listener

AGAIN = 0.02  # s, until an interrupt that was lost comes again


@contextmanager
def kept_interrupts() -> Iterator[None]:
    """Interrupt between the steps of a compilation, and again where an interrupt could not be raised.

    Python ignores what is raised in a finaliser or in a callback from C. While Numba compiles, LLVM's are
    called all the time, and what is raised there may leave LLVM's objects half freed, which ends the process.

    Raises
    ------
    KeyboardInterrupt
        When interrupted, also where a library made another error of that.
    """
    compilation, came = _Compilation(), threading.Event()
    interrupt = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: FrameType | None) -> None:
        came.set()
        if callable(interrupt):
            interrupt(number, frame)

    handled = callable(interrupt) and threading.current_thread() is threading.main_thread()
    if handled:
        signal.signal(signal.SIGINT, note)
    try:
        with (
            _raised_again(),
            install_listener("numba:compile", compilation),
            install_listener("numba:run_pass", compilation),
        ):
            yield
    except Exception as error:
        if came.is_set():
            raise KeyboardInterrupt from error
        raise
    finally:
        if handled:
            signal.signal(signal.SIGINT, interrupt)


@contextmanager
def _raised_again() -> Iterator[None]:
    """Raise a KeyboardInterrupt again that Python ignored."""
    before, timers = sys.unraisablehook, list[threading.Timer]()

    def hook(unraisable: sys.UnraisableHookArgs, /) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            before(unraisable)
            return
        timers.append(threading.Timer(AGAIN, _interrupt))
        timers[-1].daemon = True
        timers[-1].start()

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before
        for timer in timers:
            timer.cancel()


class _Compilation(Listener):
    """Holds SIGINT back while Numba is at work in the main thread, but for the moments between its steps."""

    def __init__(self) -> None:
        self._depth = 0
        self._interrupt: signal._HANDLER = None  # the handler that is kept from being called
        self._pending: list[int] = []

    def on_start(self, event: Event) -> None:
        """A compilation begins, or one of its passes."""
        if threading.current_thread() is threading.main_thread():
            self._depth += 1
            if self._depth == 1 and callable(handler := signal.getsignal(signal.SIGINT)):
                self._interrupt = handler
                signal.signal(signal.SIGINT, self._wait)

    def on_end(self, event: Event) -> None:
        """It has ended, as it should or by an error: interrupt if that was asked for meanwhile."""
        if threading.current_thread() is threading.main_thread():
            self._depth -= 1
            if self._depth == 0 and self._interrupt:
                signal.signal(signal.SIGINT, self._interrupt)
            if self._pending and callable(self._interrupt):
                self._interrupt(self._pending.pop(), None)

    def _wait(self, number: int, frame: FrameType | None) -> None:
        """Note an interrupt for later."""
        self._pending.append(number)


def _interrupt() -> None:
    """Interrupt the main thread, also where it waits."""
    if sys.platform == "win32":
        _thread.interrupt_main()
    else:
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
