"""Cells of a sweep by their labels, for studies that look at some of them."""

from __future__ import annotations

from collections.abc import Sequence

from simbias.sweep.grid import Cell, expand


def cells(overrides: Sequence[str]) -> dict[str, Cell]:
    """The cells of a sweep by their labels."""
    return {" ".join(cell.labels): cell for cell in expand(overrides).cells}


def chosen(overrides: Sequence[str], beginnings: Sequence[str]) -> list[str]:
    """The labels that begin with one of some texts.

    Raises
    ------
    SystemExit
        If no label begins with one of them, as with an override that stands behind `--cells`.
    """
    labels = list(cells(overrides))
    if unknown := [text for text in beginnings if not any(label.startswith(text) for label in labels)]:
        raise SystemExit(f"--cells: no label begins with {', '.join(unknown)}")
    return [label for label in labels if label.startswith(tuple(beginnings))]
