"""Words of others in markdown, as MLflow shows it: labels, failures and errors are text, never markup."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import unescape

MARKUP = re.compile(r"[&<>|`*\\]|\](?=[(\[])")  # of HTML, tables, code, emphasis and links


def text(words: str) -> str:
    """Words on one line, to be read as they are."""
    return MARKUP.sub(lambda found: f"&#{ord(found[0])};", " ".join(words.split()))


def code(words: str) -> str:
    """Words on one line as code, in which nothing but its end is markup."""
    return f"`{' '.join(words.split()).replace('`', ' ')}`"


def table(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """A table of words, its columns to the right."""
    lines = [map(text, head), ["--:"] * len(head), *(map(text, row) for row in body)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def cells(lines: str) -> list[list[str]]:
    """The words of a table, those of its head first."""
    head, _, *body = lines.splitlines()
    return [[unescape(cell) for cell in line[2:-2].split(" | ")] for line in (head, *body)]
