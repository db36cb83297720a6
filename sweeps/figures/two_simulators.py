"""Fig. 4: snapshots of both simulators under the policy of each."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from simbias.core import Task
from simbias.core.ranges import Count
from simbias.core.records import Iteration, Rollout
from simbias.pictures.elements.drawing import drawing_of, movement_of, share_view
from simbias.pictures.elements.style import HARDWARE, NOMINAL, SMALL, seconds
from simbias.pictures.trial.animation import animate
from simbias.pictures.trial.comparison import failure_words, first_and_last, hardware_words, policy_words
from simbias.pictures.trial.snapshots import draw_strip, ending_words
from simbias.sweep.batches import Outcomes
from simbias.sweep.figure import SweepFigure, SweptTrials
from simbias.sweep.picture import Picture
from simbias.trial.study import Study

PICTURE, TOP, HEAD, GAP, LEFT = 1.3, 0.42, 0.62, 0.12, 0.3  # snapshot, what is above it and beside, in
NOISE = 4  # apart from all other random numbers of a trial


class Run(NamedTuple):
    """A policy on a simulator."""

    policy: str
    simulator: str
    color: str
    rollout: Rollout


class TwoSimulators(SweepFigure):
    """The first and the last policy of the sweep's first trial, on the nominal model and on the hardware.

    In the paper, the first is optimised for the nominal model alone, and each policy fails on the simulator
    that it was not optimised for (Fig. 4). The two are one if the first succeeded. All start at the task's
    mean or, if the hardware cannot be set to it, where the hardware began.

    Parameters
    ----------
    columns
        Snapshots of each.
    """

    def __init__(self, task: Task, columns: Count = 6) -> None:
        draw = drawing_of(task)
        if draw is None:
            raise ValueError(f"nothing draws {type(task).__name__}")
        self._draw = draw
        self._columns = columns

    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        """The picture; its numbers are a row for each policy and simulator."""
        _, trial = next(trials.in_full())
        policies = first_and_last(trial.iterations)
        study, task = trial.study, trial.study.task
        runs = [run for iteration in policies for run in _runs(study, iteration)]
        headline = " | ".join(dict.fromkeys(run.policy for run in runs))
        film = partial(animate, task, [run[1:] for run in runs], headline)
        return Picture(
            self._figure(task, runs),
            _numbers(study, runs),
            _caption(study, runs),
            animate=None if movement_of(task) is None else film,
        )

    def _figure(self, task: Task, runs: Sequence[Run]) -> Figure:
        """A row for each run, under the words of its policy where these change."""
        times = np.linspace(0.0, seconds(task, task.horizon), self._columns)
        heads = [TOP, *[HEAD if index % 2 == 0 else GAP for index in range(1, len(runs))]]
        heights = [height for head in heads for height in (head, PICTURE)]
        figure = Figure(figsize=(LEFT + PICTURE * self._columns, sum(heights)))
        sides = {"left": LEFT / figure.get_figwidth(), "right": 1.0, "bottom": 0.03, "top": 1.0}
        grid = figure.add_gridspec(
            len(heights), self._columns, height_ratios=heights, wspace=0, hspace=0, **sides
        )
        drawings: list[Axes] = []
        before = ""
        for index, run in enumerate(runs):
            row = [figure.add_subplot(grid[2 * index + 1, column]) for column in range(self._columns)]
            failing = draw_strip(row, task, run.rollout, times, self._draw, run.color)
            _write(row[0], run.simulator, (-0.04, 0.5), rotation=90, ha="right", va="center", color=run.color)
            if failing is not None:
                _write(
                    failing,
                    ending_words(task, run.rollout),
                    (0.5, -0.01),
                    ha="center",
                    va="top",
                    color=run.color,
                )
            if run.policy != before:
                for axes, time in zip(row, times, strict=True):
                    _write(axes, f"{time:g} s", (0.5, 1.0), ha="center", va="bottom")
                _write(row[0], run.policy, (0.0, 1.14), fontweight="bold", fontsize="large")
            before = run.policy
            drawings += row
        share_view(drawings)
        return figure


def _write(axes: Axes, words: str, place: tuple[float, float], **style: Any) -> None:
    """Write words at a place in units of the axes' cell of the grid, which a wide drawing does not fill."""
    spec, figure = axes.get_subplotspec(), axes.figure
    assert spec is not None
    assert isinstance(figure, Figure)
    cell = spec.get_position(figure)
    x, y = cell.x0 + place[0] * cell.width, cell.y0 + place[1] * cell.height
    figure.text(x, y, words, **({"fontsize": SMALL} | style))


def _runs(study: Study, iteration: Iteration) -> list[Run]:
    """A policy on the nominal model and on the hardware, from the same start."""
    rng, start = np.random.default_rng([study.seed, NOISE]), study.task.start_mean
    hardware = study.experiment(iteration.parameters, rng, start)
    begin = start if study.hardware.sets_start else hardware.states[0]
    nominal = study.simulate(iteration.parameters, start=begin)
    policy = policy_words(iteration)
    return [
        Run(policy, f"nominal: {study.choices['nominal']}", NOMINAL, nominal),
        Run(policy, hardware_words(study), HARDWARE, hardware),
    ]


def _numbers(study: Study, runs: Sequence[Run]) -> pd.DataFrame:
    """How long each balanced, why it ended and what it cost."""
    return pd.DataFrame(
        {
            "policy": run.policy,
            "simulator": run.simulator,
            "seconds": seconds(study.task, run.rollout.frames),
            "failure": failure_words(study, run.rollout),
            "cost": run.rollout.cost,
        }
        for run in runs
    )


def _caption(study: Study, runs: Sequence[Run]) -> str:
    """What is seen."""
    sentences = []
    for run in runs:
        time, failure = f"{seconds(study.task, run.rollout.frames):.2f} s", failure_words(study, run.rollout)
        ending = f"fails at {time} ({failure})" if failure else f"lasts all {time}"
        sentences.append(f"{run.policy}, {run.simulator}: {ending}")
    return f"Each policy on both simulators, from the same start. {'; '.join(sentences)}."
