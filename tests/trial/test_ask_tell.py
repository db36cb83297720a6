"""study.ask() and study.tell(): a notebook is the hardware."""

from dataclasses import replace

import numpy as np
import pytest

from simbias.core import HardwareError
from simbias.core.records import Rollout
from simbias.lab.requests.request import ExperimentRequest
from simbias.trial.study import Study


def made(study: Study, request: ExperimentRequest) -> Rollout:
    """The experiment, made with the controller alone."""
    task, controller = study.task, request.controller()
    states, inputs = [request.start], []
    while len(inputs) < task.horizon and task.failure(states[-1]) is None:
        inputs.append(controller(states[-1]))
        states.append(study.nominal.step(states[-1], inputs[-1] + 2.0))  # the wind
    failure = task.failure(states[-1])
    return Rollout(np.array(states), np.array(inputs), None if failure is None else len(inputs), failure)


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_a_trial_that_is_told_is_the_one_that_runs(point_mass: Study) -> None:
    asked = 0
    while (request := point_mass.ask()) is not None:
        assert point_mass.ask() is request  # until it is told
        point_mass.tell(made(point_mass, request))
        asked += 1
    by_itself = list(point_mass.run())
    told = point_mass.ask_tell.iterations
    assert len(told) == len(by_itself) > 1
    assert asked == by_itself[-1].total_experiments
    for one, other in zip(told, by_itself, strict=True):
        np.testing.assert_array_equal(one.parameters, other.parameters)
        assert (one.hardware_cost, one.succeeded) == (other.hardware_cost, other.succeeded)
    assert point_mass.ask() is None


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_what_is_wrong_is_told_and_the_question_stays_open(point_mass: Study) -> None:
    with pytest.raises(ValueError, match=r"ask\(\) comes first"):
        point_mass.tell(Rollout(np.zeros((1, 2)), np.zeros((0, 1)), 0, "fell"))
    request = point_mass.ask()
    assert request is not None
    whole = made(point_mass, request)
    with pytest.raises(HardwareError, match=r"states: expected the shape \(101, 2\), got \(101, 1\)"):
        point_mass.tell(replace(whole, states=whole.states[:, :1]))
    assert point_mass.ask() is request
