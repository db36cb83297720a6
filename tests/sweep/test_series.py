"""Figures of many series: each is told from all others, and nothing is cut off."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from sweeping import write_sweep

from simbias.pictures.elements.layout import legend
from simbias.pictures.elements.style import COLORS, MARKERS, series_style
from simbias.sweep.figure import SweptTrials
from simbias.sweep.figures.costs import Costs
from simbias.sweep.figures.experiments import Experiments
from simbias.sweep.grid import Sweep, expand
from simbias.sweep.results import LATER

LEARNERS = ["gp", "sparse_gp", "gp_learned", "none"]
EVALUATIONS = ["nominal_start", "domain_randomization"]
EIGHT_SERIES = f"""
sweep:
  trials: 3
  axes:
    hardware.inertia_error: [0.0, 0.05]
    bias: {LEARNERS}
    evaluation: {EVALUATIONS}
"""


@pytest.fixture(scope="module")
def eight(tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    """A sweep of eight series."""
    return expand(["+sweep=eight"], write_sweep(tmp_path_factory.mktemp("eight"), "eight", EIGHT_SERIES))


def picture_of(sweep: Sweep) -> Figure:
    """The figure of a sweep whose trials are random numbers."""
    rng = np.random.default_rng(0)
    rows = [
        {
            **dict(zip((axis.name for axis in sweep.axes), cell.labels, strict=True)),
            "outcome": "succeeded",
            "experiments": rng.integers(2, 20),
            "iterations": 3,
            **LATER,
        }
        for cell in sweep.cells
        for _ in range(3)
    ]
    return Experiments().draw(SweptTrials(sweep, pd.DataFrame(rows), lambda _: None), ()).figure


def assert_nothing_is_cut(figure: Figure) -> None:
    """The legend is inside of the figure, above all axes."""
    FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    box, whole = legend.get_window_extent(), figure.bbox
    assert whole.x0 <= box.x0 < box.x1 <= whole.x1
    assert box.y1 <= whole.y1
    for axes in figure.axes:
        assert axes.get_window_extent().y1 <= box.y0 + 1


def test_styles_differ() -> None:
    styles = [series_style(index) for index in range(len(COLORS) * len(MARKERS))]
    assert len(set(styles)) == len(styles)
    assert len({style.color for style in styles[:8]}) == len({style.marker for style in styles[:8]}) == 8


@pytest.mark.slow
def test_eight_series(eight: Sweep) -> None:
    figure = picture_of(eight)
    assert_nothing_is_cut(figure)
    (axes,) = figure.axes
    points = [container.lines[0] for container in axes.containers]
    assert len({to_hex(line.get_color()) for line in points}) == 8
    assert len({line.get_marker() for line in points}) == 8
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts == [f"{bias}, {evaluation}" for bias, evaluation in itertools.product(LEARNERS, EVALUATIONS)]


@pytest.mark.slow
def test_legends_of_shipped_sweeps() -> None:
    for name in ("table2", "learning"):
        figure = picture_of(expand([f"+sweep={name}"]))
        if figure.legends:
            assert_nothing_is_cut(figure)


def test_labels_longer_than_the_figure_are_wrapped() -> None:
    labels = ["short", "a series whose name is far too long " * 4]
    figure = Figure(figsize=(4.0, 3.0), layout="constrained")
    legend(figure, {label: figure.add_subplot().plot([0, 1])[0] for label in labels})
    assert_nothing_is_cut(figure)


@pytest.mark.slow
def test_costs_of_many_cells(eight: Sweep) -> None:
    """A panel for each, in rows; their legend is whole."""
    rng = np.random.default_rng(0)
    labels = [dict(zip((axis.name for axis in eight.axes), cell.labels, strict=True)) for cell in eight.cells]

    def trial(hash_: str) -> SimpleNamespace:
        ended = int(hash_) % 2 == 0
        iterations = [
            SimpleNamespace(
                index=index,
                search=None,
                total_experiments=index + 1,
                hardware_cost=float(np.exp(rng.normal(5.0, 2.0))),
                succeeded=ended and index == 2,
            )
            for index in range(3)
        ]
        return SimpleNamespace(
            study=SimpleNamespace(cost=SimpleNamespace(max_cost=200.0)), iterations=iterations
        )

    for cells in (1, 2, 8):
        rows = [
            {**labels[cell], "hash": str(i), "repetition": i, "seed": i, "outcome": "succeeded"}
            for cell in range(cells)
            for i in range(2)
        ]
        figure = Costs().draw(SweptTrials(eight, pd.DataFrame(rows), trial), ()).figure  # type: ignore[arg-type]
        assert_nothing_is_cut(figure)
        assert sum(bool(axes.lines) for axes in figure.axes) == cells
        assert figure.get_figwidth() < 15.0
