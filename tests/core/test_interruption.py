"""Ctrl-C, where Python would lose it."""

import contextlib
import signal
import sys
import time

import pytest

from simbias.core.interruption import Interruption, deferred

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals")


class Fragile:
    def __del__(self) -> None:
        signal.raise_signal(signal.SIGINT)


def interrupted_in_a_finalizer() -> None:
    with Interruption():
        Fragile()
        time.sleep(5.0)


def test_an_interruption_that_a_finalizer_swallows_comes_again(capsys: pytest.CaptureFixture[str]) -> None:
    """As those of LLVM's objects, which Numba ends all the time while it compiles."""
    hook, handler, begin = sys.unraisablehook, signal.getsignal(signal.SIGINT), time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted_in_a_finalizer()
    assert time.monotonic() - begin < 2.0
    assert sys.unraisablehook is hook
    assert signal.getsignal(signal.SIGINT) is handler
    assert capsys.readouterr().err == ""


def interrupted_while_compiling(reached: list[str]) -> None:
    names = {"__name__": "llvmlite.binding", "signal": signal, "reached": reached}
    exec("def step():\n    signal.raise_signal(signal.SIGINT)\n    reached.append('end of the step')", names)
    with Interruption():
        names["step"]()
        time.sleep(5.0)
        reached.append("next step")


def test_a_compilation_is_interrupted_between_its_steps() -> None:
    """Never within one, where LLVM's objects would be left half freed."""
    reached: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        interrupted_while_compiling(reached)
    assert reached == ["end of the step"]


def not_installed(interrupted: bool) -> None:
    with Interruption():
        if interrupted:
            with contextlib.suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        raise ImportError("not installed")


def test_an_interruption_of_which_a_library_makes_another_error_is_one() -> None:
    """As of an interrupted import, after which a package counts as not installed."""
    with pytest.raises(KeyboardInterrupt):
        not_installed(interrupted=True)
    with pytest.raises(ImportError):
        not_installed(interrupted=False)


def interrupted_while_deferred(reached: list[str]) -> None:
    with Interruption(), deferred():
        with deferred(lambda: False):
            signal.raise_signal(signal.SIGINT)
            reached.append("inner")
        signal.raise_signal(signal.SIGINT)
        reached.append("outer")


def test_what_is_deferred_within_another_ends_neither() -> None:
    reached: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        interrupted_while_deferred(reached)
    assert reached == ["inner", "outer"]


def hung_up_twice(at_rest: list[bool]) -> None:
    """As by a shell and by the kernel."""
    try:
        signal.raise_signal(signal.SIGHUP)
    finally:
        signal.raise_signal(signal.SIGHUP)
        at_rest.append(True)


def test_a_terminal_that_closes_interrupts_but_not_what_ignores_it() -> None:
    """As a program after nohup does."""
    before = signal.getsignal(signal.SIGHUP)
    try:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        at_rest: list[bool] = []
        with pytest.raises(KeyboardInterrupt), Interruption():
            hung_up_twice(at_rest)
        assert at_rest
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        with Interruption():
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
