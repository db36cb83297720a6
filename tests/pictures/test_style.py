"""What all figures share."""

import warnings
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from simbias.pictures.elements import style


@pytest.mark.slow
def test_labels_of_others_are_drawn_in_silence(tmp_path: Path) -> None:
    """Letters that no font has, and names for which there is no room."""
    figure = Figure(figsize=(4.0, 8.0), layout="constrained")
    labels = ["\U0001f916", 100 * "x", "<b>&amp;", "one $"]
    for axes, label in zip(figure.subplots(len(labels)), labels, strict=True):
        axes.set(xlabel=label, title=label)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in ("a.png", "a.svg", "again.svg"):
            style.save(figure, tmp_path / name)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "again.svg").read_bytes()
    assert "<b>" not in (tmp_path / "a.svg").read_text()
