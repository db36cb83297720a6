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

from simbias.pictures.elements.layout import legend
from simbias.pictures.elements.style import COLORS, MARKERS, series_style
from simbias.sweep.figure import SweptTrials
from simbias.sweep.figures.costs import Costs
from simbias.sweep.figures.experiments import Experiments
from simbias.sweep.grid import Sweep, expand
from simbias.sweep.results import LATER

LEARNERS = ["gp", "sparse_gp", "gp_learned", "none"]
EVALUATIONS = ["nominal_start", "domain_randomization"]
AXES = f"{{hardware.inertia_error: [0.0, 0.05], bias: {LEARNERS}, evaluation: {EVALUATIONS}}}"


@pytest.fixture(scope="module")
def eight() -> Sweep:
    """A sweep of eight series."""
    return expand([f"+sweep={{trials: 3, axes: {AXES}}}"])


def assert_nothing_is_cut(figure: Figure) -> None:
    """The legend is inside of the figure, above all axes."""
    FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    box, whole = legend.get_window_extent(), figure.bbox
    assert whole.x0 <= box.x0 < box.x1 <= whole.x1
    assert box.y1 <= whole.y1
    assert all(axes.get_window_extent().y1 <= box.y0 + 1 for axes in figure.axes)


def labels(sweep: Sweep) -> list[dict[str, str]]:
    """Those of each cell, by axis."""
    return [dict(zip((axis.name for axis in sweep.axes), cell.labels, strict=True)) for cell in sweep.cells]


@pytest.mark.slow
def test_eight_series(eight: Sweep) -> None:
    rng = np.random.default_rng(0)
    rows = [
        {**cell, "outcome": "succeeded", "experiments": rng.integers(2, 20), "iterations": 3, **LATER}
        for cell in labels(eight)
        for _ in range(3)
    ]
    figure = Experiments().draw(SweptTrials(eight, pd.DataFrame(rows), lambda _: None), ()).figure
    assert_nothing_is_cut(figure)
    (axes,) = figure.axes
    points = [container.lines[0] for container in axes.containers]
    assert len({to_hex(line.get_color()) for line in points}) == 8
    assert len({line.get_marker() for line in points}) == 8
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == [f"{bias}, {evaluation}" for bias, evaluation in itertools.product(LEARNERS, EVALUATIONS)]
    assert len({series_style(index) for index in range(len(COLORS) * len(MARKERS))}) == len(COLORS) * len(
        MARKERS
    )


def test_labels_longer_than_the_figure_are_wrapped() -> None:
    labels = ["short", "a series whose name is far too long " * 4]
    figure = Figure(figsize=(4.0, 3.0), layout="constrained")
    legend(figure, {label: figure.add_subplot().plot([0, 1])[0] for label in labels})
    assert_nothing_is_cut(figure)


@pytest.mark.slow
def test_costs_of_many_cells(eight: Sweep) -> None:
    """A panel for each, in rows; their legend is whole."""
    study = SimpleNamespace(cost=SimpleNamespace(max_cost=200.0))

    def trial(hash_: str) -> SimpleNamespace:
        iterations = [
            SimpleNamespace(
                index=index,
                search=None,
                total_experiments=index + 1,
                hardware_cost=10.0 ** (index + 1),
                succeeded=hash_ == "0" and index == 2,
            )
            for index in range(3)
        ]
        return SimpleNamespace(study=study, iterations=iterations)

    for cells in (1, 8):
        rows = [
            {**labels(eight)[cell], "hash": str(i), "repetition": i, "seed": i, "outcome": "succeeded"}
            for cell in range(cells)
            for i in range(2)
        ]
        figure = Costs().draw(SweptTrials(eight, pd.DataFrame(rows), trial), ()).figure  # type: ignore[arg-type]
        assert_nothing_is_cut(figure)
        assert sum(bool(axes.lines) for axes in figure.axes) == cells
        assert figure.get_figwidth() < 15.0
