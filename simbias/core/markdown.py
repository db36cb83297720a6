"""Foreign text in Markdown, as MLflow shows it: labels, failures and errors are text, never markup."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import unescape

MARKUP = re.compile(r"[&<>|`*\\]|\](?=[(\[])")  # of HTML, tables, code, emphasis and links


def text(words: str) -> str:
    """Text on one line, escaped so that it is shown literally."""
    return MARKUP.sub(lambda found: f"&#{ord(found[0])};", " ".join(words.split()))


def code(words: str) -> str:
    """Text on one line as inline code, in which only the closing mark is markup."""
    return f"`{' '.join(words.split()).replace('`', ' ')}`"


def table(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """A Markdown table of texts, its columns aligned right."""
    lines = [map(text, head), ["--:"] * len(head), *(map(text, row) for row in body)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def cells(lines: str) -> list[list[str]]:
    """The cells of a table, its head first."""
    head, _, *body = lines.splitlines()
    return [[unescape(cell) for cell in line[2:-2].split(" | ")] for line in (head, *body)]
