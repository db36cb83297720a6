"""Fig. 4: snapshots of both simulators under the policy of each."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from simbias.core import Task
from simbias.core.ranges import Count
from simbias.core.records import Iteration
from simbias.pictures.elements.drawing import drawing_of, movement_of, share_view
from simbias.pictures.elements.style import HARDWARE, NOMINAL, seconds
from simbias.pictures.trial.animation import animate
from simbias.pictures.trial.comparison import (
    NamedRollout,
    failure_words,
    first_and_last,
    hardware_words,
    policy_words,
)
from simbias.pictures.trial.snapshots import draw_rows
from simbias.sweep.batches import Outcomes
from simbias.sweep.figure import Picture, SweepFigure, SweptTrials
from simbias.trial.study import Study

WIDTH, HEIGHT = 1.35, 3.3  # in, of a snapshot; of a policy's two rows
NOISE = 4  # apart from all other random numbers of a trial
Runs = list[tuple[str, list[NamedRollout]]]  # the name of each policy, and both simulators under it


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
        study, task = trial.study, trial.study.task
        runs = [(policy_words(each), _both(study, each)) for each in first_and_last(trial.iterations)]
        rollouts = [rollout for _, both in runs for rollout in both]
        film = partial(animate, task, rollouts, " | ".join(policy for policy, _ in runs))
        return Picture(
            self._figure(task, runs),
            _numbers(study, runs),
            _caption(study, runs),
            animate=None if movement_of(task) is None else film,
        )

    def _figure(self, task: Task, runs: Runs) -> Figure:
        """Two rows for each policy, under its name."""
        times = np.linspace(0.0, seconds(task, task.horizon), self._columns)
        figure = Figure(figsize=(WIDTH * self._columns, HEIGHT * len(runs)), layout="constrained")
        parts = figure.subfigures(len(runs), squeeze=False).flat
        for part, (policy, both) in zip(parts, runs, strict=True):
            part.suptitle(policy, x=0.02, ha="left", fontsize="large", fontweight="bold")
            draw_rows(part, task, both, times, self._draw)
        share_view(figure.axes)
        return figure


def _both(study: Study, iteration: Iteration) -> list[NamedRollout]:
    """A policy on the nominal model and on the hardware, from the same start."""
    study = study.designed_on(iteration.model)
    rng, start = np.random.default_rng([study.seed, NOISE]), study.task.start_mean
    hardware = study.experiment(iteration.parameters, rng, start)
    begin = start if study.hardware.sets_start else hardware.states[0]
    nominal = study.simulate(iteration.parameters, start=begin)
    return [
        NamedRollout(f"nominal: {study.choices['nominal']}", nominal, NOMINAL),
        NamedRollout(hardware_words(study), hardware, HARDWARE),
    ]


def _numbers(study: Study, runs: Runs) -> pd.DataFrame:
    """How long each balanced, why it ended and what it cost."""
    return pd.DataFrame(
        {
            "policy": policy,
            "simulator": run.name,
            "seconds": seconds(study.task, run.rollout.frames),
            "failure": failure_words(study, run.rollout),
            "cost": run.rollout.cost,
        }
        for policy, both in runs
        for run in both
    )


def _caption(study: Study, runs: Runs) -> str:
    """How each policy ends on each simulator."""
    sentences = []
    for policy, both in runs:
        for run in both:
            time, failure = (
                f"{seconds(study.task, run.rollout.frames):.2f} s",
                failure_words(study, run.rollout),
            )
            ending = f"fails at {time} ({failure})" if failure else f"lasts all {time}"
            sentences.append(f"{policy}, {run.name}: {ending}")
    return f"Each policy on both simulators, from the same start. {'; '.join(sentences)}."
