"""What all figures share."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from simbias.pictures.elements import style


@pytest.mark.parametrize("label", ["\U0001f916", 300 * "x", "<b>&amp;", "one $"])
def test_labels_of_others_are_drawn_in_silence(tmp_path: Path, label: str) -> None:
    """Letters that no font has, and names for which there is no room."""
    figure = Figure(layout="constrained")
    for axes in figure.subplots(1, 2):
        axes.set(xlabel=label, title=label)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in ("a.png", "a.svg"):
            style.save(figure, tmp_path / name)
        assert style.png(figure)
    assert "<b>" not in (tmp_path / "a.svg").read_text()
