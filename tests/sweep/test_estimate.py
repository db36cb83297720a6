"""How long a sweep may take, before it is run."""

from __future__ import annotations

import pandas as pd

from simbias.sweep.estimate import seconds_left
from simbias.sweep.grid import expand


def test_finished_trials_tell() -> None:
    """Those of the same cell where there are any, else all of them; without any, nobody knows."""
    sweep = expand(["+sweep=smoke", "tracking=none"])
    first, *others = sweep.trials
    rows = [{"hash": first.hash, sweep.axes[0].name: first.cell.labels[0], "seconds": 4.0}]
    assert seconds_left(sweep, pd.DataFrame(rows), 2) == 4.0 * len(others) / 2
    assert seconds_left(sweep, pd.DataFrame({"hash": []}), 2) is None
