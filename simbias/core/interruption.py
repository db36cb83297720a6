"""Interruption by signals, but never in the middle of writing."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")  # the last when a terminal or connection closes; not on Windows
AGAIN = 0.01  # seconds: by then, code that ignores exceptions has returned
COMPILER = "llvmlite"  # LLVM calls some of its functions, and ignores what they raise


class _Deferral:
    """Holds interruptions back once an operation has begun that must not be torn apart."""

    def __init__(self, begun: Callable[[], bool]) -> None:
        self.begun = begun
        self.interrupted = False


_deferral: _Deferral | None = None  # of the main thread, the only one that receives signals


@contextmanager
def deferred(begun: Callable[[], bool] = lambda: True) -> Iterator[None]:
    """Defer interruptions within the context, once `begun` is true; they take effect at its end.

    Contexts may be nested; the outer one then stays in force.
    """
    global _deferral
    if threading.current_thread() is not threading.main_thread() or (_deferral and _deferral.begun()):
        yield
        return
    own, outer = _Deferral(begun), _deferral
    try:
        _deferral = own
        yield
    finally:
        _deferral = outer
        if own.interrupted:
            raise KeyboardInterrupt


class Interruption:
    """Turns signals that end a process into KeyboardInterrupt, deferred where it would tear something apart.

    Without a handler, they end a process without running `finally`, which may leave a robot in motion, and
    leave workers behind. A SIGHUP that is ignored, as after `nohup`, stays so. Python ignores exceptions
    raised in finalizers and in functions called from C; the interruption is then repeated. A library may turn
    it into another error, such as a failed import; it still counts as an interruption.
    """

    def __init__(self) -> None:
        self._came = False
        self._hung_up = False
        self._before: dict[signal.Signals, Any] = {}  # handlers

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():  # no other receives signals
            for number in (getattr(signal, name) for name in SIGNALS if hasattr(signal, name)):
                if number.name != "SIGHUP" or signal.getsignal(number) != signal.SIG_IGN:
                    self._before[number] = signal.signal(number, self._handle)
            self._report, sys.unraisablehook = sys.unraisablehook, self._ignored
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if self._before:
            sys.unraisablehook = self._report
        if self._came and isinstance(error, Exception):
            raise KeyboardInterrupt from error

    def _handle(self, number: int, frame: FrameType | None) -> None:
        """Interrupt now, or note it for later.

        If a terminal closes, both its shell and the kernel send SIGHUP. The second one would interrupt the
        `finally` that brings a robot to rest, so it is ignored.
        """
        if signal.Signals(number).name == "SIGHUP":
            if self._hung_up:
                return
            self._hung_up = True
        self._came = True
        if _deferral is not None and _deferral.begun():
            _deferral.interrupted = True
        elif _compiles(frame):
            _interrupt_soon()
        else:
            raise KeyboardInterrupt

    def _ignored(self, raised: sys.UnraisableHookArgs) -> None:
        """Interrupt again if the exception was ignored."""
        if raised.exc_type is KeyboardInterrupt:
            _interrupt_soon()
        else:
            self._report(raised)


def _compiles(frame: FrameType | None) -> bool:
    """Whether the compiler is running; it returns to Python every few milliseconds."""
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] != COMPILER:
        frame = frame.f_back
    return frame is not None


def _interrupt_soon() -> None:
    """Interrupt the main thread after a moment, even while it waits."""
    if sys.platform == "win32":
        again = threading.Timer(AGAIN, _thread.interrupt_main)
    else:
        again = threading.Timer(AGAIN, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT))
    again.daemon = True  # the end of the program does not wait for it
    again.start()
