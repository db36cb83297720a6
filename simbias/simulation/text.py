"""Parts of the text of a compiled loop."""

from __future__ import annotations

from collections.abc import Iterable


def tuple_of(element: str, size: int, offset: int = 0) -> str:
    """A tuple of so many elements, written with their index, and their index after an offset."""
    return f"({''.join(element.format(i, offset + i) + ', ' for i in range(size))})"


def assign(rows: str, values: str, size: int) -> list[str]:
    """A tuple is put into a lane."""
    return [f"{rows}[{i}, lane] = {values}[{i}]" for i in range(size)]


def indent(lines: Iterable[str], spaces: int) -> str:
    """Lines after the first, which the template indents."""
    return ("\n" + " " * spaces).join(lines)
