"""Messages about errors and arbitrary values: text that can be shown, stored and sent."""

from __future__ import annotations

import re
import traceback
from urllib.parse import unquote

LONGEST = 300  # characters of a message
LONGEST_REASON = 500  # of an error's message, where it is stored
LONGEST_VALUE = 80  # of a value in a message
SHORTEST_SECRET = 4  # that is searched for in texts
SECRET = re.compile(r"\b(?!sqlite)(\w+(?:\+\w+)?)://\S*@")  # user and password in an address
COLOUR = re.compile(r"\x1b\[[0-9;]*m")  # of a terminal
SECRET_VALUE = re.compile(r"([?&]\w*(?:password|token|secret|key)\w*=)([^&\s'\"]+)", re.IGNORECASE)


def printable(text: str) -> str:
    """Text with unprintable characters escaped; line breaks stay."""
    return "".join(
        each if each.isprintable() or each in "\n\t" else each.encode("unicode_escape").decode()
        for each in text
    )


def brief(text: str, longest: int = LONGEST) -> str:
    """Text on one line, without terminal colours and control characters; the middle of a long text is cut."""
    line = printable(re.sub(r"\s*[\r\n\t]\s*", " ", COLOUR.sub("", text).strip()))
    return line if len(line) <= longest else f"{line[: longest // 2 - 2]} ... {line[3 - longest // 2 :]}"


def quote(value: object) -> str:
    """The repr of a value, shortened; some values have none, such as very large integers."""
    try:
        return brief(repr(value), LONGEST_VALUE)
    except (Exception, SystemExit):
        return f"a value of type {type(value).__name__}"


def redact(text: str, address: str = "") -> str:
    """Text without users, passwords and tokens in addresses; also without those of a known address."""
    login = re.match(r"(?!sqlite)[^:]*://(.*)@", address, re.DOTALL)
    # A parser may take the password to end at the last @, or at one of these.
    ends = [login[1], re.split("[/?#]", login[1])[0]] if login else []
    known = [part for end in ends for part in (end, end.partition(":")[2])]
    for secret in (*known, *(value for _, value in SECRET_VALUE.findall(address))):
        for each in (secret, unquote(secret)):
            text = text.replace(each, "") if len(each) >= SHORTEST_SECRET else text
    return SECRET_VALUE.sub(r"\1***", SECRET.sub(r"\1://", text))


def counted(count: int, noun: str) -> str:
    """A count with its noun, in the plural if needed."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def words(error: BaseException, longest: int = LONGEST_REASON) -> str:
    """The message of an error, shortened, or its type if it has none; some messages cannot be read at all."""
    try:
        return brief(str(error), longest) or type(error).__name__
    except (Exception, SystemExit):
        return "(its message cannot be read)"


def with_type(error: BaseException, longest: int = LONGEST_REASON) -> str:
    """An error's type and message."""
    name, said = type(error).__name__, words(error, longest)
    return name if said == name else f"{name}: {said}"


def with_trace(error: BaseException) -> str:
    """An error's traceback."""
    try:
        return printable("".join(traceback.format_exception(error)))
    except Exception:
        return with_type(error)
