"""What is said of errors and values: text that can be shown, stored and sent, whatever they are."""

from __future__ import annotations

import traceback
from typing import Any

REASON_LENGTH = 500  # characters of an error in one line
VALUE_LENGTH = 80  # of a value in it


def printable(text: str) -> str:
    """Text in which what cannot be shown or encoded is written as an escape; lines stay lines."""
    return "".join(
        each if each.isprintable() or each in "\n\t" else each.encode("unicode_escape").decode()
        for each in text
    )


def one_line(error: BaseException, length: int = REASON_LENGTH) -> str:
    """An error's message, not too long; some errors cannot even say what they are."""
    try:
        return printable(" ".join(str(error).split()))[:length]
    except (Exception, SystemExit):
        return "(its message cannot be read)"


def with_type(error: BaseException, length: int = REASON_LENGTH) -> str:
    """An error's type and message."""
    return ": ".join(filter(None, [type(error).__name__, one_line(error, length)]))


def with_trace(error: BaseException) -> str:
    """An error's traceback."""
    try:
        return printable("".join(traceback.format_exception(error)))
    except Exception:
        return with_type(error)


def value(thing: Any) -> str:
    """A value in one short line."""
    try:
        text = printable(" ".join(repr(thing).split()))
    except (Exception, SystemExit):
        text = type(thing).__name__
    return text if len(text) <= VALUE_LENGTH else f"{text[: VALUE_LENGTH - 4]} ..."
