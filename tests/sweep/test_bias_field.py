"""Fig. 5: what is learned, against experiments that it was not learned from."""

import itertools
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest

import simbias
from simbias.config import compose
from simbias.core import Hardware, Policy
from simbias.core.records import Array, Iteration, Learning, Rollout
from simbias.sweep.figure import FigureError, Picture, SweptTrials
from simbias.sweep.figures.bias_field import BiasField
from simbias.sweep.figures.success_rates import Range, SuccessRates
from simbias.sweep.figures.two_simulators import TwoSimulators
from simbias.sweep.grid import Cell, expand
from simbias.trial.study import Study

pytestmark = pytest.mark.slow

STATES = ("alpha_w", "alpha_b", "theta")
FALLING = np.array([8.118, 4.731, -6.740, -1.024, -4.0])  # in about a second
EXPERIMENTS = 2


class Trial(NamedTuple):
    """As the store gives it back."""

    study: Study
    iterations: tuple[Iteration, ...]


class Noting(Hardware):
    """Hardware that notes where its experiments start, and their policies."""

    def __init__(self, hardware: Hardware) -> None:
        self._hardware = hardware
        self.starts: list[tuple[float, ...]] = []
        self.policies: list[Policy] = []

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        self.starts.append(tuple(start))
        self.policies.append(policy)
        return self._hardware.run(policy, theta, start, rng)


@pytest.fixture(scope="module")
def trial() -> Trial:
    """A trial of two iterations: one to learn from, one with what was learned."""
    study = simbias.load(["task.horizon=1500"])
    study = replace(study, hardware=Noting(study.hardware))
    rollouts = tuple(study.experiment(FALLING, rng) for rng in np.random.default_rng(study.seed).spawn(4))
    selection = study.samples.select(rollouts, study.nominal)
    data = selection.transitions
    first = Iteration(
        index=0,
        parameters=FALLING,
        experiments=rollouts,
        hardware_cost=300.0,
        succeeded=False,
        total_experiments=4,
        model=study.model(study.bias.fit(study.no_data)),
        learning=Learning(selection, data),
    )
    last = replace(first, index=1, total_experiments=8, model=study.model(study.bias.fit(data)))
    return Trial(study, (first, last))


@pytest.fixture(scope="module")
def picture(trial: Trial) -> Picture:
    return picture_of(trial)


def swept(trial: Trial) -> SweptTrials:
    table = pd.DataFrame([{"hash": "0", "outcome": "succeeded", "repetition": 0}])
    return SweptTrials(expand(["+sweep=fig5"]), table, lambda _: trial)


def picture_of(trial: Trial) -> Picture:
    return BiasField(trial.study.task, STATES, EXPERIMENTS).draw(swept(trial), ())


def test_what_is_learned_predicts_what_was_not_seen(trial: Trial, picture: Picture) -> None:
    """Without a bias, all of the residual is left; held-out experiments start where none did before."""
    errors = picture.numbers.set_index("state")
    assert (errors["samples"] > 50).all()
    assert (errors.loc[["alpha_b", "d_alpha_b"], ["relative_mean", "relative_eq7"]] < 0.6).all(axis=None)
    assert isinstance(hardware := trial.study.hardware, Noting)
    assert len(hardware.starts) == len(set(hardware.starts)) == 4 + 2 * EXPERIMENTS
    first, last = trial.iterations
    last = replace(last, model=first.model)  # which nothing was learned for
    zero = picture_of(trial._replace(iterations=(first, last)))
    nothing = zero.numbers
    assert "learns nothing" in zero.caption
    assert "learns nothing" not in picture.caption
    assert nothing["relative_mean"].tolist() == nothing["relative_eq7"].tolist() == [1.0] * 6
    assert nothing["residual"].to_numpy() == pytest.approx(errors["residual"].to_numpy())


def test_arrows_are_velocities(trial: Trial, picture: Picture) -> None:
    """All arrows stand for the same time, in which the bias of the angles would carry the state along."""
    picture.figure.draw_without_rendering()
    values = [text.get_window_extent() for text in picture.figure.axes[3].texts]
    assert len(values) == 12
    assert not any(one.overlaps(other) for one, other in itertools.combinations(values, 2))
    panels = [axes for axes in picture.figure.axes if axes.collections]
    assert len(panels) == 3
    data, truth, prediction = panels[0].collections[:3]
    transitions = trial.iterations[0].learning.data
    assert np.asarray(data.get_offsets()) == pytest.approx(transitions.inputs[:, :2])
    ratio = np.concatenate([data.U, data.V]) / transitions.residuals[:, :2].T.ravel()
    assert ratio == pytest.approx(np.full(len(ratio), ratio[0]))
    assert np.asarray(truth.get_offsets()) == pytest.approx(np.asarray(prediction.get_offsets()))
    assert len(truth.get_offsets()) == 40
    assert np.corrcoef(truth.U, prediction.U)[0, 1] > 0.7


def test_what_cannot_be_drawn_is_one_line(trial: Trial) -> None:
    strict = simbias.load(["samples.limits.distance=1e-9"]).samples
    with pytest.raises(FigureError, match="no held-out sample"):
        picture_of(trial._replace(study=replace(trial.study, samples=strict)))
    iterations = tuple(replace(iteration, model=None) for iteration in trial.iterations)
    with pytest.raises(FigureError, match="not searched"):
        picture_of(trial._replace(iterations=iterations))
    with pytest.raises(FigureError, match="trial 0 ended before an iteration did"):
        picture_of(trial._replace(iterations=()))


def test_a_policy_runs_as_it_was_designed_on_its_model(trial: Trial) -> None:
    study, designed, last = trial.study, copy(trial.study.policy), trial.iterations[-1]
    noting = study.hardware
    assert isinstance(noting, Noting)
    trial = trial._replace(iterations=(replace(last, model=replace(last.model, policy=designed)),))
    for figure in (BiasField(study.task, STATES, 1), TwoSimulators(study.task, 2)):
        noting.policies.clear()
        figure.draw(swept(trial), ())
        assert noting.policies == [designed]
    ranges = (Range(name, -0.1, 0.1, 2) for name in STATES[:2])
    cells = [Cell((), compose([]).trial, "")]
    with pytest.raises(FigureError, match="output_feedback is designed on its trial's model"):
        SuccessRates(study.task, cells, *ranges, 1, "").experiments(swept(trial))
