"""What is wrong with an override, a key or a value, in one line."""

from __future__ import annotations

import re

LONGEST = 300  # characters of what a message says,
LONGEST_KEY = 160  # of the key or file that it names,
LONGEST_VALUE = 80  # and of a value in it


class ConfigError(ValueError):
    """A bad override, key or value; its message is one line, not too long."""

    def __init__(self, key: str, problem: str) -> None:
        self.key, self.problem = brief(key, LONGEST_KEY), brief(problem)
        super().__init__(f"{self.key}: {self.problem}" if key else self.problem)

    def __reduce__(self) -> tuple[type[ConfigError], tuple[str, str]]:
        """So that it comes back from a worker as what it is."""
        return ConfigError, (self.key, self.problem)


def brief(text: str, longest: int = LONGEST) -> str:
    """Text on one line, without its middle if it is long; nothing in it moves a terminal's cursor."""
    one = re.sub(r"\s*[\r\n]\s*", " ", text.strip())
    line = "".join(letter if letter.isprintable() else "?" for letter in one)
    return line if len(line) <= longest else f"{line[: longest // 2 - 2]} ... {line[3 - longest // 2 :]}"


def quoted(value: object) -> str:
    """A value as Python writes it, not too long; some values cannot be written, as very large integers."""
    try:
        return brief(repr(value), LONGEST_VALUE)
    except Exception:
        return f"a value of type {type(value).__name__}"


def words(error: BaseException) -> str:
    """What an error says, or else what it is; some errors cannot even say that."""
    try:
        return brief(str(error)) or type(error).__name__
    except Exception:
        return type(error).__name__
