"""Methods against each other: the figure, of three methods in one cell."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from simbias.sweep.figure import FigureError, SweptTrials
from simbias.sweep.figures.comparison import Comparison
from simbias.sweep.grid import Sweep, expand

pytestmark = pytest.mark.slow

METHODS = "{LQR: {method: lqr}, LQI: {method: lqi, policy: integral_feedback}, ideal: {method: ideal}}"
AXES = f"{{cell: {{points: {{cart-pole: {{preset: cartpole}}}}}}, method: {{points: {METHODS}}}}}"


@pytest.fixture(scope="module")
def sweep() -> Sweep:
    return expand([f"+sweep={{trials: 3, common_seeds: [method], axes: {AXES}}}"])


def made_up(sweep: Sweep, texts: dict[str, list[str]]) -> SweptTrials:
    """Trials whose last policies last in these test episodes; an error where there is no text."""
    rows = [
        {
            "cell": trial.cell.labels[0],
            "method": trial.cell.labels[1],
            "hash": trial.hash,
            "repetition": trial.repetition,
            "experiments": 2.0 if text else np.nan,
            "outcome": "succeeded" if text else "error",
            "test_episodes": text,
            "lasting_episodes": text,
        }
        for trial in sweep.trials
        for text in texts.get(trial.cell.labels[1], [])[trial.repetition : trial.repetition + 1]
    ]
    return SweptTrials(sweep, pd.DataFrame(rows), lambda _: None)  # type: ignore[arg-type,return-value]


def test_numbers_are_those_of_the_trials(sweep: Sweep) -> None:
    all_of_16, half, fallen = "1" * 16, "10" * 8, "0" * 16
    texts = {"LQI": [half, half, fallen], "ideal": [all_of_16] * 3, "LQR": [fallen, fallen, ""]}
    picture = Comparison("method", ["LQI"]).draw(made_up(sweep, texts), ())
    numbers = picture.numbers.set_index("method")
    assert numbers["holds"].to_dict() == {"LQR": 0, "LQI": 0, "ideal": 3}
    assert numbers["raised"].to_dict() == {"LQR": 1, "LQI": 0, "ideal": 0}
    assert numbers["mean_share"].to_dict() == pytest.approx({"LQR": 0.0, "LQI": 1 / 3, "ideal": 1.0})
    assert numbers["better LQI"].dropna().to_dict() == pytest.approx({"LQR": 1 / 6, "ideal": 1.0})
    assert numbers.loc["ideal", "p LQI"] == pytest.approx(2 * 2 * 0.5**3)  # three pairs of two tests
    assert numbers.loc["ideal", "holds_low"] == pytest.approx(0.438, abs=1e-3)
    assert "most hold by ideal: 3 (44% to 100%)" in picture.caption
    FigureCanvasAgg(picture.figure).draw()


def test_without_tests_there_is_nothing_to_compare(sweep: Sweep) -> None:
    with pytest.raises(FigureError, match=r"policy_test\.episodes=16"):
        Comparison("method").draw(made_up(sweep, {"LQI": [""] * 3}), ())
    with pytest.raises(FigureError, match="no such axis or point: method, LQX"):
        Comparison("method", ["LQX"]).draw(made_up(sweep, {"LQI": ["1"] * 3}), ())
