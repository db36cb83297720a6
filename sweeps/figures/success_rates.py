"""Fig. 7: how often learned policies balance, over a grid of starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from simbias.config.build import build
from simbias.core import Task
from simbias.core.proportions import CONFIDENCE, wilson
from simbias.core.ranges import Coordinate, Count
from simbias.core.records import Array
from simbias.pictures.elements.style import HARDWARE, SIMULATION, SMALL, label, literal, plain
from simbias.sweep.batches import Batch, Outcomes
from simbias.sweep.figure import FigureError, Picture, SweepFigure, SweptTrials
from simbias.sweep.grid import Cell

if TYPE_CHECKING:
    from simbias.trial.run import TrialRecord

COLOURS = "cividis"  # even to the colour-blind, and in grey
PANEL, ASIDE, HEIGHT = 3.3, 2.6, 4.2  # widths of a map and of the rates beside the maps, height of both, in
MOST_IN_A_ROW, LINE = 3, 32  # maps; characters of a map's title


@dataclass(frozen=True)
class Range:
    """Values of a state, evenly spaced, at which experiments start."""

    state: str
    low: Coordinate  # in the state's unit
    high: Coordinate
    points: Count

    @property
    def values(self) -> Array:
        """The values (points,)."""
        return np.linspace(self.low, self.high, self.points)


class SuccessRates(SweepFigure):
    """Success rates of the policies with which the trials of each cell ended, on the same hardware (Fig. 7).

    Parameters
    ----------
    x, y
        The two states whose starts are varied; the others start at the task's mean.
    experiments
        With each policy from each start. Where these always end alike, as without noise, they count as one.
    hardware
        Label of the cell on whose hardware all policies are tried.
    """

    def __init__(
        self,
        task: Task,
        cells: Sequence[Cell],
        x: Range,
        y: Range,
        experiments: Count,
        hardware: str,
    ) -> None:
        names = [quantity.name for quantity in task.states]
        for state in (x.state, y.state):
            if state not in names:
                raise ValueError(f"the task has no state {state}; it has {', '.join(names)}")
        compositions = {" ".join(cell.labels): cell.composition for cell in cells}
        if hardware not in compositions:
            raise ValueError(f"the sweep has no cell {hardware}; it has {', '.join(compositions)}")
        self._task = task
        self._x, self._y = x, y
        self._experiments = experiments
        self._hardware = compositions[hardware]

    def experiments(self, trials: SweptTrials) -> Sequence[Batch]:
        """A batch is a policy, tried once from every start.

        The i-th trials of all cells meet the same noise.

        Raises
        ------
        FigureError
            If the hardware cannot be set to a start, or a policy is designed on its trial's model.
        """
        if not build(self._hardware).hardware.sets_start:
            hardware = self._hardware.choices["hardware"]
            raise FigureError(f"hardware {hardware} begins where it stands: it cannot start on a grid")
        return [
            Batch(self._hardware, _last_policy(trial), self._starts(), seed)
            for row, trial in trials.in_full()
            for seed in range(
                row["repetition"] * self._experiments, (row["repetition"] + 1) * self._experiments
            )
        ]

    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        """The picture; its numbers are a row for each policy and start."""
        successes = np.array([batch.successes for batch in outcomes]).reshape(
            -1, self._experiments, self._y.points, self._x.points
        )
        if (successes == successes[:, :1]).all():
            successes = successes[:, :1]
        counts = np.count_nonzero(successes, axis=1)  # (policies, y, x)
        y, x = self._grid()
        numbers = pd.concat(
            pd.DataFrame(
                {
                    "cell": trials.cell(row),
                    "repetition": row["repetition"],
                    "learning": row["outcome"],
                    self._x.state: x.ravel(),
                    self._y.state: y.ravel(),
                    "experiments": successes.shape[1],
                    "succeeded": own.ravel(),
                }
            )
            for row, own in zip(trials.rows, counts, strict=True)
        )
        return Picture(self._figure(numbers), numbers, self._caption(numbers))

    def _grid(self) -> list[Array]:
        """Both states (y.points, x.points) at all starts, that of y first."""
        return list(np.meshgrid(self._y.values, self._x.values, indexing="ij"))

    def _starts(self) -> Array:
        """The starts (y.points * x.points, n), x changing fastest."""
        index = {quantity.name: i for i, quantity in enumerate(self._task.states)}
        y, x = self._grid()
        starts = np.tile(self._task.start_mean, (x.size, 1))
        starts[:, index[self._x.state]], starts[:, index[self._y.state]] = x.ravel(), y.ravel()
        return starts

    def _figure(self, numbers: pd.DataFrame) -> Figure:
        """A map for each cell, and the rate of every policy over the whole grid beside or below them."""
        cells = [own for _, own in numbers.groupby("cell", sort=False)]
        columns = min(len(cells), MOST_IN_A_ROW)
        rows = -(-len(cells) // columns)
        widths, below = [*[PANEL] * columns, ASIDE][: columns + (rows == 1)], int(rows > 1)
        size = sum(widths) + 0.8, HEIGHT * (rows + below)
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.add_gridspec(rows + below, len(widths), width_ratios=widths)
        maps = [figure.add_subplot(grid[divmod(index, columns)]) for index in range(len(cells))]
        aside = figure.add_subplot(grid[-1, :] if below else grid[0, -1])
        quantities = {quantity.name: quantity for quantity in self._task.states}
        for axes, own in zip(maps, cells, strict=True):
            sums = own.groupby([self._y.state, self._x.state])[["succeeded", "experiments"]].sum()
            rates = (sums["succeeded"] / sums["experiments"]).to_numpy()
            mesh = axes.pcolormesh(
                self._x.values,
                self._y.values,
                rates.reshape(self._y.points, self._x.points),
                cmap=COLOURS,
                vmin=0.0,
                vmax=1.0,
                rasterized=True,
            )
            axes.set(
                xlabel=label(quantities[self._x.state]),
                ylabel=label(quantities[self._y.state]),
            )
            axes.set_title(fill(literal(own["cell"].iloc[0]), LINE), fontsize="medium")
        figure.colorbar(mesh, ax=maps, label="success rate", pad=0.02)
        _draw_policies(aside, cells)
        return figure

    def _caption(self, numbers: pd.DataFrame) -> str:
        """The caption, from the numbers."""
        sentences = []
        for cell, own in numbers.groupby("cell", sort=False):
            rates = _of_policies(own)
            successes = (rates["learning"] == "succeeded").sum()
            sentences.append(
                f"{cell}: {own['succeeded'].sum() / own['experiments'].sum():.1%} of all experiments succeed "
                f"({rates['rate'].min():.1%} to {rates['rate'].max():.1%} with each of the {len(rates)} "
                f"policies, {successes} of which had succeeded when learning ended)"
            )
        counts = numbers.groupby(["cell", self._x.state, self._y.state])["experiments"].sum()
        few, many = int(counts.min()), int(counts.max())
        half = max(np.ptp(wilson(k, few)) / 2 for k in range(few + 1))
        n = f"{few}" if few == many else f"{few} to {many} (by cell)"
        alike = ", where those with one policy are all alike and count as one"
        alike *= bool((numbers["experiments"] < self._experiments).all())
        return (
            f"Success rate on the same hardware of the policies with which learning ended, "
            f"over starts at {self._x.points} x {self._y.points} values of {self._x.state} and "
            f"{self._y.state}. {'; '.join(sentences)}. There are {n} experiments from each start{alike}: if "
            f"they are independent, a {CONFIDENCE:.0%} Wilson interval reaches at most {half:.2f} to either "
            "side of its middle. "
            "Last panel: each policy over the whole grid, with its interval."
        )


def _last_policy(trial: TrialRecord) -> Array:
    """The parameters of a trial's last policy, which are all that a batch of experiments is told of it."""
    study, last = trial.study, trial.iterations[-1]
    if study.designed_on(last.model) is not study:
        policy = study.choices["policy"]
        raise FigureError(f"policy {policy} is designed on its trial's model: no other hardware can run it")
    return last.parameters


def _of_policies(own: pd.DataFrame) -> pd.DataFrame:
    """Rate of each policy of a cell over the whole grid, with its interval."""
    policies = own.groupby("repetition").agg(
        learning=("learning", "first"), succeeded=("succeeded", "sum"), experiments=("experiments", "sum")
    )
    policies["rate"] = policies["succeeded"] / policies["experiments"]
    bounds = [wilson(*map(int, pair)) for pair in policies[["succeeded", "experiments"]].to_numpy().tolist()]
    policies["low"], policies["high"] = zip(*bounds, strict=True)
    return policies


def _draw_policies(axes: Axes, cells: Sequence[pd.DataFrame]) -> None:
    """Rates of the policies, side by side for each cell."""
    for index, own in enumerate(cells):
        policies = _of_policies(own)
        x = index + 0.6 * ((np.arange(len(policies)) + 0.5) / len(policies) - 0.5)
        spread = [policies["rate"] - policies["low"], policies["high"] - policies["rate"]]
        axes.errorbar(x, policies["rate"], spread, fmt="none", ecolor="0.5", capsize=2, zorder=1)
        success = (policies["learning"] == "succeeded").to_numpy()
        for mask, color, marker, words in (
            (success, SIMULATION, "o", "learning succeeded"),
            (~success, HARDWARE, "X", "it did not"),
        ):
            if mask.any():
                axes.plot(x[mask], policies["rate"][mask], marker, color=color, label=words, clip_on=False)
    names = [fill(literal(own["cell"].iloc[0]), 14) for own in cells]
    axes.set_xticks(range(len(cells)), names, fontsize=SMALL)
    axes.set_xlim(-0.6, len(cells) - 0.4)
    highest = max(_of_policies(own)["high"].max() for own in cells)
    axes.set_ylim(0.0, 1.3 * highest)  # room for the legend
    axes.set_yticks([tick for tick in axes.get_yticks() if tick <= 1.0])
    handles, entries = axes.get_legend_handles_labels()
    unique = dict(zip(entries, handles, strict=True))
    axes.legend(unique.values(), unique.keys(), frameon=False, fontsize=SMALL, loc="upper right")
    axes.set_title("success rate of each policy,\nover all starts", fontsize="medium")
    plain(axes)
