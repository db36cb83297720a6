"""Errors about an override, a key or a value, in one line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from simbias.core.messages import LONGEST, brief, quote, words

LONGEST_KEY = 160  # characters of a key or file name in a message


class ConfigError(ValueError):
    """A bad override, key or value; its message is one line, not too long."""

    def __init__(self, key: str, problem: str) -> None:
        self.key, self.problem = brief(key, LONGEST_KEY), brief(problem, LONGEST)
        super().__init__(f"{self.key}: {self.problem}" if key else self.problem)

    def __reduce__(self) -> tuple[type[ConfigError], tuple[str, str]]:
        """Pickle the key and message, so that the error survives the way back from a worker."""
        return ConfigError, (self.key, self.problem)


def check_list(key: str, values: Any, kinds: type | tuple[type, ...], what: str) -> None:
    """Raise ConfigError unless the values are a list of these kinds; a text is a sequence of texts, too."""
    listed = isinstance(values, Sequence) and not isinstance(values, str | bytes)
    if not listed or not all(isinstance(each, kinds) for each in values):
        raise ConfigError(key, f"expected a list of {what}, got {quote(values)}")


class StudyWarning(UserWarning):
    """Warns that a study works, but slowly, or perhaps not as intended; the message says what to do."""


def reason(error: Exception) -> str:
    """The reason why a file or a value was refused, in words."""
    if isinstance(error, RecursionError):
        return "a defaults list refers back to itself, or values are nested too deeply"
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}: {error.filename}" if error.filename else error.strerror
    return words(error)
