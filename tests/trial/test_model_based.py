"""What the model-based method adds to Algorithm 1, one option at a time."""

import json
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from point_mass import PointMass, WithoutWind
from scripted import FRAMES, ScriptedHardware
from scripted import scripted as run_scripted

import simbias
from simbias.core import Evaluation, Model
from simbias.core.errors import ConfigError
from simbias.core.records import Iteration, Rollout
from simbias.learning.bias.none import NoBias
from simbias.policy.output_feedback import OutputFeedback
from simbias.search import lqr
from simbias.search.evaluation.nominal_start import NominalStart
from simbias.search.lqr import lqr_policies
from simbias.trial.budget import Budget
from simbias.trial.methods.algorithm1 import Algorithm1
from simbias.trial.methods.lqr import Lqr
from simbias.trial.methods.model_based import ModelBased
from simbias.trial.observer import Observer
from simbias.trial.run import read_trial, run_trial
from simbias.trial.steps import RANDOM_KNOTS
from simbias.trial.study import Study

pytestmark = pytest.mark.usefixtures("uncompiled")


def scripted(study: Study, predicted: list[float], hardware: list[float], **options: Any) -> list[Iteration]:
    """Run with the costs that searches predict and experiments have, two an iteration; Z_max is 0.1875."""
    return run_scripted(study, ModelBased(**options), predicted, hardware)


def test_with_its_defaults_it_is_algorithm_1(point_mass: Study) -> None:
    """Also where a search clears the model."""
    costs = [0.1, 0.19, 0.1], [0.9] * 4 + [0.0] * 2
    both = (run_scripted(point_mass, method, *costs) for method in (Algorithm1(), ModelBased()))
    for one, other in zip(*both, strict=True):
        assert one.learning.reset == other.learning.reset
        assert one.total_experiments == other.total_experiments
        np.testing.assert_array_equal(one.parameters, other.parameters)
        np.testing.assert_array_equal(one.learning.data.residuals, other.learning.data.residuals)


def test_kept_data_outlive_a_bad_search(point_mass: Study) -> None:
    """Lines 6-8 left out."""
    iterations = scripted(point_mass, [0.1, 0.19, 0.1], [0.9] * 4 + [0.0] * 2, keep_data=True)
    max_cost = point_mass.cost.max_cost
    assert [i.search.predicted_cost > max_cost for i in iterations] == [False, True, False]
    assert [i.learning.reset for i in iterations] == [False] * 3
    assert [len(i.learning.data) for i in iterations] == [10, 20, 20]


def test_an_iteration_may_stop_at_its_first_failure(point_mass: Study) -> None:
    """Only experiments that were made count; a failure in the last one saves none."""
    iterations = scripted(point_mass, [0.1] * 3, [0.9, 0.1, 0.8, 0.1, 0.1], stop_at_failure=True)
    assert [[r.cost for r in i.experiments] for i in iterations] == [
        pytest.approx(costs) for costs in ([0.9], [0.1, 0.8], [0.1, 0.1])
    ]
    assert [i.total_experiments for i in iterations] == [1, 3, 5]
    assert [i.hardware_cost for i in iterations] == pytest.approx([0.9, 0.8, 0.1])
    assert [len(i.learning.data) for i in iterations] == [5, 15, 15]
    at_limit = point_mass.cost.max_cost  # is no success (line 10)
    first, _ = scripted(point_mass, [0.1] * 2, [at_limit, 0.0, 0.0], stop_at_failure=True)
    assert len(first.experiments) == 1


@pytest.mark.slow
def test_stopping_early_changes_no_later_start(hasty: Study) -> None:
    """Iterations compare on common random numbers."""
    whole, stopped = (
        list(replace(hasty, bias=NoBias(), method=ModelBased(3, stop_at_failure=stop)).run())
        for stop in (False, True)
    )
    assert [len(i.experiments) for i in stopped] == [1, 1, 1]
    for a, b in zip(whole, stopped, strict=True):
        np.testing.assert_array_equal(a.experiments[0].states, b.experiments[0].states)


def test_a_failed_search_is_made_again(point_mass: Study) -> None:
    """Before hardware is spent on its policy; the evaluations are those of all searches."""
    once = scripted(point_mass, [0.1], [0.0] * 2)
    first, second = scripted(point_mass, [0.3, 0.19, 0.1, 0.1], [0.9] * 2 + [0.0] * 2, retry_search=2)
    assert first.search.predicted_cost == 0.1
    assert not first.learning.reset
    assert first.search.optimum.evaluations == 3 * once[0].search.optimum.evaluations
    assert first.search.optimum.stopped_by.endswith(", in search 3 of 3")
    assert second.search.optimum.evaluations == once[0].search.optimum.evaluations
    assert second.search.optimum.stopped_by == once[0].search.optimum.stopped_by
    costs = [0.3, 0.2, 0.25, 0.1], [0.9] * 2 + [0.0] * 2
    first, last = scripted(point_mass, *costs, retry_search=2)  # lines 6-9 follow, with the best of all
    assert first.search.predicted_cost == 0.2
    assert first.search.optimum.stopped_by.endswith(", in search 2 of 3")
    assert (first.learning.reset, len(first.experiments), last.succeeded) == (True, 2, True)


def test_the_target_cost_may_be_less_than_z_max_and_is_never_more(point_mass: Study) -> None:
    """A search that ends between the two is made again, and clears nothing if it ends there again."""
    (first,) = scripted(point_mass, [0.3, 0.1], [0.0] * 2, retry_search=1, target_cost=20.0)
    assert first.search.optimum.stopped_by.endswith(", in search 2 of 2")
    options = {"retry_search": 1, "target_cost": 0.15}
    first, last = scripted(point_mass, [0.19, 0.18, 0.1], [0.9] * 2 + [0.0] * 2, **options)
    assert first.search.predicted_cost == 0.18
    assert first.search.optimum.stopped_by.endswith(", with no cost below 0.15, in search 2 of 2")
    assert not first.learning.reset
    assert " search " not in last.search.optimum.stopped_by


class Spread(Evaluation):
    """Predicts the deviation of the models that a search draws, as its cost."""

    def objective(self, model, cost, rng):
        return lambda theta: model.nominal.deviation


class Uncertain(WithoutWind):
    """A model whose draws deviate from it."""

    deviation = 1.0

    def narrowed(self, scale):
        nearer = copy(self)
        nearer.deviation = scale * self.deviation
        return nearer


def test_a_search_made_again_draws_nearer_models(point_mass: Study) -> None:
    """With half of the deviations each time, until a policy holds on them; the next iteration begins anew."""
    task = PointMass(horizon=FRAMES)
    study = replace(point_mass, task=task, evaluation=Spread(), nominal=Uncertain(task))
    method = ModelBased(2, retry_search=3, posterior_scale=0.5)
    for iteration in replace(study, method=method, hardware=ScriptedHardware([0.9] * 4)).run():
        assert iteration.search.predicted_cost == 0.125
        assert iteration.search.optimum.stopped_by.endswith(", in search 4 of 4")
    method = ModelBased(1, retry_search=3)
    (same,) = replace(study, method=method, hardware=ScriptedHardware([0.9] * 2)).run()
    assert same.search.predicted_cost == 1.0


class Recorded(NominalStart):
    """Keeps the policies that each search evaluates."""

    def __init__(self, task: PointMass) -> None:
        super().__init__(task)
        self.searches: list[list[np.ndarray]] = []

    def objective(self, model, cost, rng):
        objective, evaluated = super().objective(model, cost, rng), []
        self.searches.append(evaluated)
        return lambda theta: evaluated.append(theta) or objective(theta)


@pytest.mark.slow
def test_a_search_may_begin_with_lqr(hasty: Study) -> None:
    study = replace(
        hasty,
        evaluation=Recorded(hasty.task),
        bias=NoBias(),
        policy=OutputFeedback(hasty.task),
        method=ModelBased(1, lqr_candidates=1),
    )
    list(study.run())
    expected = lqr_policies(study.model())
    assert len(expected) > 1
    np.testing.assert_array_equal(study.evaluation.searches[0][: len(expected)], expected)


@pytest.mark.slow
def test_a_search_may_begin_with_the_last_policy_or_with_that_of_a_file(hasty: Study, tmp_path: Path) -> None:
    task = PointMass(horizon=FRAMES)
    study = replace(hasty, task=task, evaluation=Recorded(task), bias=NoBias())
    searches = study.evaluation.searches
    for from_last in (True, False):
        searches.clear()
        method = ModelBased(2, from_last=from_last)
        first, _ = replace(study, method=method, hardware=ScriptedHardware([0.9] * 4)).run()
        assert np.array_equal(searches[1][0], first.parameters) == from_last
    file = tmp_path / "policy.json"
    file.write_text(json.dumps({"parameters": first.parameters.tolist()}))
    method = ModelBased(1, first_policy=str(file))
    begun = replace(study, method=method, hardware=ScriptedHardware([0.9] * 2))
    made = run_trial(begun, tmp_path / "trial").iterations[0]
    np.testing.assert_array_equal(searches[-1][0], first.parameters)
    file.unlink()
    again = read_trial(begun, tmp_path / "trial").iterations[0]
    np.testing.assert_array_equal(again.parameters, made.parameters)
    file.write_text('{"parameters": [1, 2.5, 0]}')  # by hand
    method.check(study)
    for parameters in ([0.0], "none", [*first.parameters[1:].tolist(), "0"]):
        file.write_text(json.dumps({"parameters": parameters}))
        with pytest.raises(ConfigError, match=r"method\.first_policy: .*policy\.json"):
            method.check(study)


@pytest.mark.slow
def test_a_search_that_is_replayed_designs_no_lqr(
    hasty: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    models: list[Model] = []
    monkeypatch.setattr(lqr, "lqr_policies", lambda model, **_: models.append(model) or lqr_policies(model))
    study = replace(hasty, policy=OutputFeedback(hasty.task), method=ModelBased(1, lqr_candidates=2))
    policies = [run_trial(study, tmp_path / study.hash).iterations[0].parameters for _ in range(2)]
    assert len(models) == 2
    np.testing.assert_array_equal(*policies)


def test_success_may_ask_for_more_passes(point_mass: Study) -> None:
    """Further experiments follow those of an iteration as long as all pass, and count."""
    hardware = [0.9, 0.0] + [0.0, 0.0, 0.9] + [0.0] * 4
    iterations = scripted(point_mass, [0.1] * 3, hardware, passes=4)
    assert [i.succeeded for i in iterations] == [False, False, True]
    assert [i.total_experiments for i in iterations] == [2, 5, 9]
    hardware = [0.9] + [0.0, 0.0, 0.9] + [0.0] * 4
    iterations = scripted(point_mass, [0.1] * 3, hardware, passes=4, stop_at_failure=True)
    assert [i.total_experiments for i in iterations] == [1, 4, 8]
    assert ModelBased(max_iterations=3, experiments=2, passes=4).max_experiments == 12
    for method in (ModelBased, Lqr):
        with pytest.raises(ValueError, match="passes: 1 are fewer than the 2 experiments"):
            method(passes=1)


@pytest.mark.slow
def test_random_experiments_come_first_and_are_learned_from(hasty: Study) -> None:
    """Inputs at the knots are at the limits; the first search knows what was learned; they count."""
    study = replace(hasty, method=ModelBased(max_iterations=1, random_experiments=2))
    made: list[Rollout] = []

    class Made(Observer):
        def experimented(self, rollout: Rollout) -> None:
            made.append(rollout)

    (iteration,) = study.run(Made())
    horizon, (lower, upper) = study.task.horizon, study.task.input_bounds
    at_knots = made[0].inputs[:: horizon // (RANDOM_KNOTS - 1)]
    assert set(np.unique(at_knots.round(9))) == {*lower, *upper}
    assert not np.array_equal(made[0].inputs, made[1].inputs)
    assert iteration.total_experiments == len(made) == 2 + len(iteration.experiments)
    x, u = made[0].states[:1], made[0].inputs[:1]
    assert not study.first_model().bias.correction(x, u).any()
    assert iteration.model.bias.correction(x, u).any()
    assert study.max_experiments == 2 + study.method.experiments
    record = run_trial(study)
    assert record.summary.experiments == len(made)
    assert record.summary.hardware_seconds == sum(each.frames for each in made) * study.task.time_step
    for budget, done, drawn in (
        (1, "No policy had been tried", "1 random experiment"),
        (3, "The only policy had passed 0 of 1 experiment", "2 random experiments"),
    ):
        reason = run_trial(replace(study, budget=Budget(budget))).summary.reason
        assert reason == f"{done} when the budget was spent, after {drawn}."


def test_random_experiments_need_limits(point_mass: Study) -> None:
    task = copy(point_mass.task)
    task.input_limit = np.array([np.inf])
    study = replace(point_mass, task=task, method=ModelBased(random_experiments=1))
    with pytest.raises(ConfigError, match=r"^method.random_experiments: need limits of all inputs; force"):
        study.method.check(study)
    reacher = simbias.load(["preset=reacher", "tracking=none"])
    with pytest.raises(ConfigError, match=r"^method.random_experiments: must be 0 for a task with targets"):
        study.method.check(reacher)
