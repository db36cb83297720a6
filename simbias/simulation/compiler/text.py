"""Parts of the text of a compiled loop."""

from __future__ import annotations

from collections.abc import Sequence


def tuple_of(element: str, size: int, offset: int = 0) -> str:
    """The text of a tuple of `size` elements, each written with its index and its index after an offset."""
    return f"({''.join(element.format(i, offset + i) + ', ' for i in range(size))})"


def sum_of(terms: Sequence[str]) -> str:
    """The sum of terms, in pairs, so that few of them wait for each other.

    A kernel has its long sums written out. Where a loop takes elements of a long tuple by their index, LLVM
    keeps the loop, and with it the whole closed loop out of the lanes.
    """
    if len(terms) < 2:
        return "".join(terms) or "0.0"
    half = len(terms) // 2
    return f"({sum_of(terms[:half])} + {sum_of(terms[half:])})"


def assign(rows: str, values: str, size: int) -> list[str]:
    """A tuple is put into a lane."""
    return [f"{rows}[{i}, lane] = {values}[{i}]" for i in range(size)]
