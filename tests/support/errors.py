"""Errors that a person reads."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from simbias.core.errors import ConfigError


@contextmanager
def one_line(
    words: str | None = None, error: type[Exception] = ConfigError
) -> Iterator[pytest.ExceptionInfo[Exception]]:
    """What is raised within it is a single line, in which these words (a pattern) are."""
    with pytest.raises(error, match=words) as caught:
        yield caught
    assert "\n" not in str(caught.value), words
