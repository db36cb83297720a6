"""Lines on a terminal: progress, and the traceback files that they name."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from tempfile import NamedTemporaryFile

from rich.console import Console

from simbias.core.messages import with_trace

TRACEBACK = "simbias-error-"  # prefix of files kept for a person


def standard_output(soft_wrap: bool = False) -> Console:
    """The console; plain text if it is not a terminal, although notebooks set FORCE_COLOR for their pipes."""
    force_terminal = None if sys.stdout.isatty() else False
    return Console(highlight=False, soft_wrap=soft_wrap, force_terminal=force_terminal)


def say(console: Console, line: str, style: str = "", markup: bool = False) -> None:
    """Print a line that stays one line when it is copied, however narrow the terminal is."""
    console.print(line, style=style, markup=markup, soft_wrap=True)


@contextmanager
def progress(console: Console) -> Iterator[Callable[[str], None]]:
    """A function that shows the current activity; without a terminal, each call prints a line."""
    with console.status("") as status:
        yield status.update if console.is_terminal else partial(say, console)


def place_of_trace(error: BaseException) -> str:
    """The place of an error's traceback, in brackets for the end of a message; "" if it cannot be written."""
    file = temporary_traceback(with_trace(error))
    return f" (traceback in {file})" if file else ""


def temporary_traceback(traceback: str) -> str:
    """A new file with a traceback, for a person; "" if it cannot be written."""
    try:
        with NamedTemporaryFile("w", prefix=TRACEBACK, suffix=".txt", delete=False) as file:
            file.write(traceback)
    except OSError:
        return ""
    return file.name
