"""Words of others in markdown, as MLflow shows it: labels, failures and errors are text, never markup."""

from __future__ import annotations

import re

MARKUP = re.compile(r"[&<>|`*\\]|\](?=[(\[])")  # of HTML, tables, code, emphasis and links


def text(words: str) -> str:
    """Words on one line, to be read as they are."""
    return MARKUP.sub(lambda found: f"&#{ord(found[0])};", " ".join(words.split()))


def code(words: str) -> str:
    """Words on one line as code, in which nothing but its end is markup."""
    return f"`{' '.join(words.split()).replace('`', ' ')}`"
