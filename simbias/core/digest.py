"""Short digests that identify trials, requests and code."""

from __future__ import annotations

import hashlib

DIGITS = 12  # hexadecimal


def short_digest(content: bytes) -> str:
    """The first hexadecimal digits of the SHA-256 of some content."""
    return hashlib.sha256(content).hexdigest()[:DIGITS]
