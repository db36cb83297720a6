"""Ctrl-C, where Python would lose it."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections.abc import Iterator

import pytest
from numba.core.event import Event, EventStatus, broadcast

from simbias.terminal.interrupts import kept_interrupts

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals")


@pytest.fixture(autouse=True)
def interruptible() -> Iterator[None]:
    """A background job ignores SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


@kept_interrupts()
def interrupted_in_a_finaliser() -> None:
    class Fragile:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    Fragile()
    time.sleep(5)


def test_an_interrupt_that_a_finaliser_swallows_comes_again(capsys: pytest.CaptureFixture[str]) -> None:
    """As those of LLVM's objects, which Numba ends all the time while it compiles."""
    hook = sys.unraisablehook
    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted_in_a_finaliser()
    assert time.monotonic() - begin < 2.0
    assert sys.unraisablehook is hook
    assert capsys.readouterr().err == ""


@kept_interrupts()
def interrupted_while_compiling(reached: list[str]) -> None:
    broadcast(Event("numba:compile", EventStatus.START))
    signal.raise_signal(signal.SIGINT)
    reached.append("the step's end")
    broadcast(Event("numba:compile", EventStatus.END))
    reached.append("the next step")


def test_a_compilation_is_interrupted_between_its_steps() -> None:
    """Never within one, where LLVM's objects would be left half freed."""
    reached: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        interrupted_while_compiling(reached)
    assert reached == ["the step's end"]


@kept_interrupts()
def not_installed(number: int) -> None:
    with contextlib.suppress(KeyboardInterrupt):
        signal.raise_signal(number)
    raise ImportError("not installed")


def test_an_interrupt_of_which_a_library_makes_another_error_is_one() -> None:
    """As of an interrupted import, after which a package counts as not installed."""
    with pytest.raises(KeyboardInterrupt):
        not_installed(signal.SIGINT)
    with pytest.raises(ImportError):
        not_installed(signal.SIGCHLD)
