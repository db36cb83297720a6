"""What a trial remarks on: undetermined parameters that a policy stands on, residuals, chattering inputs."""

from dataclasses import replace

import numpy as np
import pytest

import simbias
from simbias.core.records import Iteration, Optimum, Rollout, Search
from simbias.learning.bias.none import ConstantBias
from simbias.learning.identification.directions import undetermined
from simbias.learning.identification.identified import Identified
from simbias.search.evaluation.robust import Robust
from simbias.search.lqr import INPUT_WEIGHTS, lqr_policies
from simbias.trial.diagnostics import of_inputs, of_model, of_policy, of_prediction, of_trial
from simbias.trial.study import Study
from simbias.trial.summary import iteration_summary

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("uncompiled")]


@pytest.fixture(scope="module")
def study() -> Study:
    """A pole on a cart, which an LQR policy of its model holds upright."""
    return simbias.load(["preset=cartpole", "tracking=none"])


def of_spread(study: Study, open_deviation: float) -> tuple[Identified, list[str]]:
    """The model at the prior's median, its pole's length open; what is said of its LQR policy."""
    names = [parameter.name for parameter in study.nominal.parameters]
    spread, p = np.diag([open_deviation if name == "length" else 0.01 for name in names]), len(names)
    nominal = Identified(study.nominal, np.zeros(p), spread, {})
    model = study.model(None, nominal)
    (theta,) = lqr_policies(model, (INPUT_WEIGHTS[1],))
    return nominal, [remark.words for remark in of_model(theta, model, study.cost)]


def test_it_is_told_and_the_direction_named(study: Study) -> None:
    """Once in full in an iteration's events; also among a trial's diagnostics, which reports show."""
    nominal, said = of_spread(study, 6.0)
    (direction,) = undetermined(nominal)
    assert direction.weights == {"length": 1.0}
    assert said == [
        "this policy lasts in simulation, but fails on a model one standard deviation away along "
        "length, which the experiments do not determine"
    ]
    model = study.model(None, nominal)
    (theta,) = lqr_policies(model, (INPUT_WEIGHTS[1],))
    made = [Iteration(index, theta, (), 0.0, False, 0, model) for index in range(2)]
    kind = "a policy stands on what the data do not determine"
    assert kind in {remark.kind for remark in of_trial(made, study)}
    first, second = (iteration_summary(study, made[i], made[:i])["events"] for i in range(2))
    assert any("one standard deviation away along length, which" in event for event in first)
    assert kind in second


def test_a_residual_that_is_added_to_drawn_models_is_told(study: Study) -> None:
    theta, drawing = np.zeros(4), replace(study, evaluation=Robust(study.task, sample_nominal=True))
    residual = ConstantBias(np.full(4, 1e-3), np.zeros(4))
    for told, model, searched in (
        (True, study.model(residual), drawing),
        (False, study.model(residual), replace(study, evaluation=Robust(study.task))),
        (False, study.model(residual, of_spread(study, 0.6)[0]), drawing),
        (False, study.model(), drawing),
    ):
        kinds = {remark.kind for remark in of_prediction(theta, model, searched)}
        assert ("a residual is added to drawn models" in kinds) == told


def test_a_residual_is_one_of_the_robot_whatever_its_targets() -> None:
    """Of a task with targets, whose searches draw models."""
    study = simbias.load(["preset=reacher", "tracking=none"])
    theta, residual = np.zeros(study.policy.n_parameters), ConstantBias(np.full(4, 1e-3), np.zeros(4))
    kinds = {remark.kind for remark in of_prediction(theta, study.model(residual), study)}
    assert "a residual is added to drawn models" in kinds


def test_nothing_is_said_where_the_policy_lasts_or_all_is_determined(study: Study) -> None:
    assert of_spread(study, 0.6)[1] == []
    assert undetermined(of_spread(study, 0.4)[0]) == []
    assert list(of_model(np.zeros(2), study.model(), study.cost)) == []


@pytest.mark.parametrize(("share", "told"), [(0.09, False), (0.11, True)])
def test_an_input_that_changes_much_from_frame_to_frame_is_told(
    study: Study, share: float, told: bool
) -> None:
    """As a share of its range, on average over experiments; an experiment of one frame tells nothing."""
    (force,) = study.task.inputs
    swing = share * np.subtract(*study.task.input_bounds[::-1]) / 2.0
    states, inputs = np.zeros((101, 4)), np.where(np.arange(100)[:, None] % 2, swing, -swing)
    said = [
        each.words for each in of_inputs([Rollout(states, inputs), Rollout(states[:2], inputs[:1])], study)
    ]
    assert len(said) == told
    assert not told or said[0].startswith(f"{force.name} changes by 11% of its range from frame to frame")
    assert not told or said[0].endswith(" inputs in the cost may help")  # no filter
    assert not list(of_inputs([Rollout(states[:2], inputs[:1])], study))
    filtered = simbias.load(["preset=cartpole_trajectory", "tracking=none"])
    made = Rollout(states, inputs * filtered.task.input_limit / study.task.input_limit)
    assert [each.words.endswith("noisy rates (policy.observer)") for each in of_inputs([made], filtered)] == [
        True
    ] * told


def test_plans_that_cost_the_same_are_not_arbitrary_unless_they_are_searched() -> None:
    search = Search(Optimum(np.zeros(1), 2.0, 3, "evaluations", flat=True), 0.0)
    for preset, count in (("cartpole_trajectory", 0), ("[cartpole_trajectory,near_plan]", 1)):
        model = simbias.load([f"preset={preset}", "tracking=none"]).first_model()
        said = of_policy(np.zeros(model.policy.n_parameters), model, search, [])
        assert [each.kind for each in said] == ["all simulated policies cost the same"] * count
