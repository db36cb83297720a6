"""The figure of last policies, of trials that are made up."""

from __future__ import annotations

import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from simbias.sweep.figure import FigureError, SweptTrials
from simbias.sweep.figures.last_policies import LastPolicies
from simbias.sweep.grid import Sweep, expand
from simbias.sweep.picture import Picture

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sweep() -> Sweep:
    return expand(["+sweep=gaps"])


def drawn(sweep: Sweep, starts: dict[str, list[str]]) -> Picture:
    """The figure of a sweep of which so many trials have ended, and one more that raised."""
    rows = [
        {"gap": gap, "repetition": i, "outcome": "succeeded" if i else "not succeeded", "experiments": 4 + i}
        | {"test_episodes": text}
        for gap, texts in starts.items()
        for i, text in enumerate(texts)
    ]
    raised = {"gap": "lag 20 ms", "repetition": 0, "outcome": "error", "experiments": 1, "test_episodes": ""}
    return LastPolicies().draw(SweptTrials(sweep, pd.DataFrame([*rows, raised]), lambda _: None), ())  # type: ignore[arg-type]


def test_shares_are_of_all_starts(sweep: Sweep) -> None:
    picture = drawn(sweep, {"slope 0.02 rad": ["1111", "1100"], "slope 0.05 rad": ["0000", "1111"]})
    assert picture.numbers["success_rate"].tolist() == pytest.approx([1, 1 / 2, 0, 1])
    assert picture.numbers["experiments"].tolist() == [4, 5, 4, 5]
    for words in ("of 4 test episodes", "2/4 [15%, 85%] trials end", "in 0 of 2 cells"):
        assert words in picture.caption
    with pytest.raises(FigureError, match=r"policy_test\.episodes=20"):
        drawn(sweep, {"slope 0.02 rad": ["", ""]})


def test_every_trial_is_a_dot_that_no_other_hides(sweep: Sweep) -> None:
    """On the left by its experiments, on the right by its share; a row of the axes for each cell."""
    figure = drawn(sweep, {"slope 0.02 rad": ["1111"] * 10}).figure
    FigureCanvasAgg(figure).draw()
    left, right = figure.axes
    assert len(left.get_yticklabels()) == 24
    dots = [tuple(at) for some in right.collections[1:] for at in some.get_offsets()]  # type: ignore[union-attr]
    assert len(set(dots)) == 10
    assert all(abs(height) < 0.5 for _, height in dots)
