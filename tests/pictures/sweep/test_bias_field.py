"""Fig. 5: what is learned, against experiments that it was not learned from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import simbias
from simbias.interfaces import Hardware
from simbias.pictures.sweep.bias_field import BiasField
from simbias.pictures.sweep.picture import Picture
from simbias.pictures.sweep.swept import FigureError, SweptTrials
from simbias.records import Array, Iteration, Optimum, Rollout
from simbias.study import Study
from simbias.sweep.grid import expand
from simbias.tracking.results import frame
from simbias.tracking.trials import RecordedTrial

STATES = ("alpha_w", "alpha_b", "theta")
FALLING = np.array([8.118, 4.731, -6.740, -1.024, -4.0])  # in about a second
EXPERIMENTS = 3


class Noting(Hardware):
    """Hardware that notes where its experiments start."""

    def __init__(self, hardware: Hardware) -> None:
        self._hardware = hardware
        self.starts: list[tuple[float, ...]] = []

    def run(self, policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        self.starts.append(tuple(start))
        return self._hardware.run(policy, theta, start, rng)


def learned(*overrides: str, replaced: Callable[[Study], Study] = lambda study: study) -> RecordedTrial:
    """A trial of two iterations: one to learn from, one with what was learned."""
    study = replaced(simbias.load(["tracking=none", "task.horizon=1500", *overrides]))
    rollouts = tuple(study.experiment(FALLING, rng) for rng in np.random.default_rng(study.seed).spawn(4))
    selection = study.samples.select(rollouts, study.nominal)
    data = selection.transitions
    first = Iteration(
        index=0,
        optimum=Optimum(FALLING, 1.0, 1, "the test"),
        predicted_cost=1.0,
        model_reset=False,
        experiments=rollouts,
        hardware_cost=300.0,
        succeeded=False,
        total_experiments=4,
        selection=selection,
        data=data,
        fitted_bias=study.bias.fit(study.no_data),
    )
    last = replace(first, index=1, total_experiments=8, fitted_bias=study.bias.fit(data))
    return RecordedTrial("0", study, (first, last))


def drawn(trial: RecordedTrial) -> Picture:
    sweep = expand(["+sweep=fig5"])
    table = frame([{"run_id": "0", "outcome": "succeeded"}], sweep)
    figure = BiasField(trial.study.task, STATES, EXPERIMENTS)
    return figure.draw(SweptTrials(sweep, table, lambda _: trial), ())


def test_what_is_learned_predicts_what_was_not_seen() -> None:
    """Without a bias, all of the residual is left."""
    errors = drawn(learned()).numbers.set_index("state")
    assert (errors["samples"] > 50).all()
    assert (errors.loc[["alpha_b", "d_alpha_b"], ["relative_mean", "relative_eq7"]] < 0.6).all(axis=None)
    nothing = drawn(learned("bias=none")).numbers
    assert nothing["relative_mean"].tolist() == nothing["relative_eq7"].tolist() == [1.0] * 6
    assert nothing["residual"].to_numpy() == pytest.approx(errors["residual"].to_numpy())


def test_held_out_experiments_are_new() -> None:
    trial = learned(replaced=lambda study: replace(study, hardware=Noting(study.hardware)))
    hardware = trial.study.hardware
    assert isinstance(hardware, Noting)
    met = set(hardware.starts)
    drawn(trial)
    assert len(met) == 4
    assert len(set(hardware.starts)) == 4 + 2 * EXPERIMENTS


def test_arrows_are_velocities() -> None:
    """All arrows stand for the same time, in which the bias of the angles would carry the state along."""
    trial = learned()
    picture = drawn(trial)
    panels = [axes for axes in picture.figure.axes if axes.collections]
    assert len(panels) == 3
    data, truth, prediction = panels[0].collections[:3]
    transitions = trial.iterations[0].data
    assert np.asarray(data.get_offsets()) == pytest.approx(transitions.inputs[:, :2])
    ratio = np.concatenate([data.U, data.V]) / transitions.residuals[:, :2].T.ravel()
    assert ratio == pytest.approx(np.full(len(ratio), ratio[0]))
    assert np.asarray(truth.get_offsets()) == pytest.approx(np.asarray(prediction.get_offsets()))
    assert len(truth.get_offsets()) == 40
    assert np.corrcoef(truth.U, prediction.U)[0, 1] > 0.7


def test_without_any_sample() -> None:
    trial = learned("samples.limits.distance=1e-9")
    with pytest.raises(FigureError, match="no held-out sample"):
        drawn(trial)
