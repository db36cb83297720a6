"""No model: f' = 0 (Eq. 2), or positions that move by their rates and nothing else."""

from copy import copy

import numpy as np
import pytest

import simbias
from simbias.core import Quantity, rate_pairs
from simbias.robots.none import NoNominal
from simbias.trial.observer import Observer
from simbias.trial.steps import search
from simbias.trial.study import Study

SCRATCH = ["preset=[pendulum_swingup,scratch]", "tracking=none"]


@pytest.fixture(scope="module")
def study() -> Study:
    return simbias.load(SCRATCH)


@pytest.mark.slow
def test_without_a_model_nothing_moves_or_positions_by_their_rates(study: Study) -> None:
    """What is left of a semi-implicit step is its acceleration, in rate and position."""
    x, u = np.array([[0.3, -2.0], [3.1, 4.0]]), np.ones((2, 1))
    np.testing.assert_array_equal(NoNominal(study.task).step(x, u), x)
    h = study.task.time_step
    np.testing.assert_allclose(study.nominal.step(x, u), x + h * x[:, 1:] * [1.0, 0.0], rtol=1e-15)
    rates = x[:, 1:] + h * np.array([[5.0], [-7.0]])
    residual = np.concatenate([x[:, :1] + h * rates, rates], axis=1) - study.nominal.step(x, u)
    np.testing.assert_allclose(residual, h * np.array([[5.0 * h, 5.0], [-7.0 * h, -7.0]]), rtol=1e-9)


def test_rates_are_told_by_units_and_names() -> None:
    """In any order; where names do not tell, as those of one unit follow each other."""
    for states, pairs in (
        ("x angle d_angle d_x", [(0, 3), (1, 2)]),
        ("x d_x angle d_angle", [(0, 1), (2, 3)]),
        ("q1 q10 q10_dot q1_dot", [(0, 3), (1, 2)]),
        ("q1 q2 v1 v2 heading", [(0, 2), (1, 3)]),
    ):
        quantities = [
            Quantity(name, ("m" if "x" in name else "rad") + "/s" * (name[0] in "dv" or "dot" in name))
            for name in states.split()
        ]
        assert rate_pairs(quantities) == pairs


@pytest.mark.slow
def test_positions_without_rates_of_their_own_are_refused(study: Study) -> None:
    task = copy(study.task)
    task.states = (*task.states, Quantity("other", "rad"))
    with pytest.raises(ValueError, match="needs one rate for each position, by units; unpaired: other"):
        NoNominal(task, kinematics=True)


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_a_first_search_without_a_model_says_that_no_policy_changes_the_cost() -> None:
    """It ends with its first generation; the policy is a random one, another for another seed."""
    one_stage = ["evaluation=fresh_randomization", "optimizer.explorations=4", "optimizer.population=4"]
    study = simbias.load([*SCRATCH, "task.horizon=60", *one_stage])
    model = study.first_model()
    found, other = (search(study, model, np.random.default_rng(i), Observer()).optimum for i in (0, 1))
    assert found.stopped_by.startswith("costs that no policy changes")
    assert found.flat
    assert found.evaluations == 8
    assert np.abs(found.parameters - other.parameters).max() > 0.5
