"""Fig. 5: the velocity field of the learned bias."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from simbias.core import Task
from simbias.core.ranges import Count
from simbias.core.records import Array, Selection, Transitions
from simbias.pictures.elements.style import HARDWARE, SMALL, label, plain, symbol
from simbias.sweep.batches import Outcomes
from simbias.sweep.figure import FigureError, Picture, SweepFigure, SweptTrials

if TYPE_CHECKING:
    from simbias.trial.run import TrialRecord

DATA, PREDICTION, TRUTH = "#56B4E9", HARDWARE, "0.1"  # as the paper's cyan, red and blue
LONG = 0.15  # of an arrow that is longer than 95% of them, as a part of the widest axis
HELD_OUT = 5  # apart from all other random numbers of a trial
ThreeStates = tuple[str, str, str]


class Validation(NamedTuple):
    """Residuals of experiments that were not learned from, and their predictions."""

    data: Transitions  # that was learned from
    selection: Selection  # of the held-out experiments
    mean: Array  # (N, n) of the bias, Eq. 4
    weighted: Array  # (N, n) with its weight, the last term of Eq. 7


class Field(NamedTuple):
    """Arrows of one colour."""

    places: Array  # (k, 3) of the three states
    velocities: Array  # (k, 3)
    color: str
    width: float  # pt
    label: str


class BiasField(SweepFigure):
    """The bias that the last policy of the sweep's first trial was searched on, against held-out experiments.

    Arrows are the residuals of Eq. 6 over the time step, in the subspace of three states: training data,
    prediction and truth (Fig. 5). The truth is of experiments with each of the trial's policies, from starts
    that the trial did not meet; which of their samples count is decided as for learning (Section IV-C).

    Parameters
    ----------
    states
        The three; by default the task's first.
    experiments
        Held-out ones with each policy.
    arrows
        Held-out samples that are drawn, far from each other; all count in the error.
    """

    def __init__(
        self, task: Task, states: ThreeStates | None = None, experiments: Count = 4, arrows: Count = 40
    ) -> None:
        names = [quantity.name for quantity in task.states]
        if states is None and len(names) < 3:
            raise ValueError(f"a field is drawn over three states; the task has {', '.join(names)}")
        for state in states or ():
            if state not in names:
                raise ValueError(f"the task has no state {state}; it has {', '.join(names)}")
        self._task = task
        self._axes = [names.index(state) for state in states or names[:3]]
        self._experiments = experiments
        self._arrows = arrows

    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        """The picture; its numbers are the held-out errors of every state."""
        _, trial = next(trials.in_full())
        validation = self._validate(trial)
        if not len(validation.selection.transitions):
            raise FigureError("no held-out sample is one to learn from (Section IV-C)")
        errors = self._errors(validation)
        experiments = self._experiments * len(trial.iterations)
        return Picture(
            self._figure(validation, errors), errors, self._caption(validation, errors, experiments)
        )

    def _validate(self, trial: TrialRecord) -> Validation:
        """Experiments that the trial did not make, and what its bias predicts of them."""
        study, model = trial.study, trial.iterations[-1].model
        if model is None:
            raise FigureError("the trial's last policy was not searched in a simulation with a bias")
        bias = model.bias
        rng = np.random.default_rng([study.seed, HELD_OUT])
        rollouts = [
            study.designed_on(iteration.model).experiment(iteration.parameters, experiment_rng)
            for iteration in trial.iterations
            for experiment_rng in rng.spawn(self._experiments)
        ]
        selection = study.select(rollouts, model.nominal)
        inputs, n = selection.transitions.inputs, selection.transitions.residuals.shape[1]
        weighted = bias.correction(inputs[:, :n], inputs[:, n:])
        lessons = [iteration.learning for iteration in trial.iterations[:-1] if iteration.learning]
        data = lessons[-1].data if lessons else study.no_data
        return Validation(data, selection, bias.predict(inputs)[0], weighted)

    def _errors(self, validation: Validation) -> pd.DataFrame:
        """Root mean squares over the held-out samples: of every state's residual, and of what is left."""
        truth = validation.selection.transitions.residuals
        table = pd.DataFrame(
            {
                "state": [quantity.name for quantity in self._task.states],
                "unit": [quantity.unit for quantity in self._task.states],
                "samples": len(truth),
                "residual": _rms(truth),
                "error_of_mean": _rms(truth - validation.mean),
                "error_of_eq7": _rms(truth - validation.weighted),
            }
        )
        for name in ("mean", "eq7"):
            table[f"relative_{name}"] = table[f"error_of_{name}"] / table["residual"]
        return table

    def _figure(self, validation: Validation, errors: pd.DataFrame) -> Figure:
        """The field in its three projections, and the errors."""
        figure = Figure(figsize=(10.0, 8.2), layout=ConstrainedLayoutEngine(h_pad=0.12))
        grid = figure.subplots(2, 2).ravel()
        fields = self._fields(validation)
        width = max(np.ptp(np.concatenate([field.places for field in fields]), axis=0))
        speeds = np.linalg.norm(np.concatenate([field.velocities for field in fields]), axis=1)
        seconds = LONG * width / np.percentile(speeds, 95)  # that an arrow covers
        for axes, pair in zip(grid, itertools.combinations(range(3), 2), strict=False):
            self._draw_projection(axes, fields, list(pair), seconds)
        _draw_errors(grid[3], errors)
        handles = [Line2D([], [], color=field.color, lw=field.width, label=field.label) for field in fields]
        figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False)
        return figure

    def _fields(self, validation: Validation) -> list[Field]:
        """The arrows, from back to front."""
        truth = validation.selection.transitions
        few = _far_apart(truth.inputs[:, self._axes], self._arrows)
        at, u, v = truth.inputs[few], truth.residuals[few], validation.mean[few]
        training = f"training data, {len(validation.data)} samples"
        return [
            self._field(validation.data.inputs, validation.data.residuals, DATA, 0.6, training),
            self._field(at, u, TRUTH, 2.2, "truth at held-out samples"),
            self._field(at, v, PREDICTION, 1.0, "prediction there (mean, Eq. 4)"),
        ]

    def _field(self, inputs: Array, residuals: Array, color: str, width: float, words: str) -> Field:
        """Residuals (k, n) at inputs (k, n+m) as arrows."""
        velocities = residuals[:, self._axes] / self._task.time_step
        return Field(inputs[:, self._axes], velocities, color, width, words)

    def _draw_projection(self, axes: Axes, fields: Sequence[Field], pair: list[int], seconds: float) -> None:
        """Two of the three dimensions."""
        for field in fields:
            arrows = axes.quiver(
                *field.places[:, pair].T,
                *(seconds * field.velocities[:, pair]).T,
                color=field.color,
                angles="xy",
                scale_units="xy",
                scale=1.0,
                units="inches",
                width=field.width / 72,
            )
        ends = [p for f in fields for p in (f.places[:, pair], (f.places + seconds * f.velocities)[:, pair])]
        axes.update_datalim(np.concatenate(ends))
        axes.autoscale_view()
        velocity = 10.0 ** np.floor(np.log10(0.2 * np.ptp(axes.get_xlim()) / seconds))
        words = f"{velocity:g} {self._task.states[self._axes[0]].unit}/s"
        axes.quiverkey(
            arrows,
            0.8,
            1.03,
            seconds * velocity,
            words,
            labelpos="E",
            color=TRUTH,
            fontproperties={"size": SMALL},
        )
        horizontal, vertical = (self._task.states[self._axes[index]] for index in pair)
        axes.set(xlabel=label(horizontal), ylabel=label(vertical))
        plain(axes)

    def _caption(self, validation: Validation, errors: pd.DataFrame, experiments: int) -> str:
        """The caption, from the numbers."""
        selection, rows = validation.selection, errors.to_dict("records")
        left = ", ".join(
            f"{row['state']} {row['relative_mean']:.0%} ({row['relative_eq7']:.0%})" for row in rows
        )
        count, sampled = len(selection.transitions), selection.sampled
        samples = f"{len(validation.data)} samples"
        learned = f"The bias learned from {samples}"
        if not validation.mean.any():
            learned = f"The zero bias of the sweep's first trial, which learns nothing from its {samples}"
        return (
            f"{learned}, as velocities, against {experiments} "
            f"experiments from other starts ({count} samples; {sampled - count} more rejected as in "
            "learning). Root mean square of what the mean leaves of the residual, over that of the residual "
            f"itself (in brackets: with the weight of Eq. 7): {left}."
        )


def _rms(values: Array) -> Array:
    """Root mean square of the columns of (N, n)."""
    return np.sqrt(np.mean(values**2, axis=0))


def _far_apart(points: Array, count: int) -> Array:
    """Indices of up to `count` of the points (N, 3), each the farthest from those before it."""
    indices = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(indices) < min(count, len(points)):
        indices.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[indices[-1]], axis=1))
    return np.array(indices)


def _draw_errors(axes: Axes, errors: pd.DataFrame) -> None:
    """The held-out error of every state, relative to the residual itself."""
    x, onto_white = np.arange(len(errors)), withStroke(linewidth=2.0, foreground="white")
    for aside, name, color, words in (
        (-0.2, "relative_mean", PREDICTION, "of the mean (Eq. 4)"),
        (0.2, "relative_eq7", "#E69F00", "of the weighted mean (Eq. 7)"),
    ):
        bars = axes.bar(x + aside, errors[name], 0.38, color=color, label=words)
        axes.bar_label(bars, fmt=" %.2f", fontsize=SMALL, rotation=90, path_effects=[onto_white])
    axes.axhline(1.0, color=TRUTH, linewidth=0.8, label="of the nominal model")
    ticks = [
        f"{symbol(row['state'])}\n{row['residual']:.1e}\n{row['unit']}" for row in errors.to_dict("records")
    ]
    axes.set_xticks(x, ticks, fontsize=SMALL)
    axes.set_xlabel("state, and the rms of its residual in a time step", fontsize=SMALL)
    axes.set_ylabel("held-out rms error / rms residual")
    axes.legend(loc="upper left", frameon=False, fontsize=SMALL, ncols=2)
    axes.set_ylim(0.0, 1.4 * max(1.0, errors[["relative_mean", "relative_eq7"]].to_numpy().max()))
    plain(axes)
