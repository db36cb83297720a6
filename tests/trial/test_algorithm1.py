"""Algorithm 1, line by line, on a robot whose components count and can be told what to do."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from point_mass import Distance, PointMass, WithoutWind

from simbias.core import Evaluation, FittedBias, Hardware, HardwareError, Model
from simbias.core.records import Array, Iteration, Rollout
from simbias.learning.bias.none import NoBias
from simbias.policy.output_feedback import OutputFeedback
from simbias.search import lqr as design
from simbias.search.evaluation.nominal_start import NominalStart
from simbias.search.lqr import regulated
from simbias.search.optimizer.nlopt import Nlopt
from simbias.trial.journal import Journal
from simbias.trial.methods.algorithm1 import Algorithm1
from simbias.trial.run import run_trial
from simbias.trial.study import Observer, Study

FRAMES = 25  # of a scripted experiment: five become training data


class ScriptedPrediction(Evaluation):
    """Predicts one cost for every policy of an iteration."""

    def __init__(self, predicted_costs: list[float]) -> None:
        self._costs = iter(predicted_costs)

    def objective(self, simulator, cost, rng):
        predicted = next(self._costs)
        return lambda theta: predicted


class ScriptedHardware(Hardware):
    """Ends each experiment with the cost it is told, by the point mass's mean distance."""

    def __init__(self, costs: list[float]) -> None:
        self._costs = iter(costs)

    def run(self, policy, theta, start, rng):
        states = np.full((FRAMES + 1, 2), next(self._costs))
        return Rollout(states, np.zeros((FRAMES, 1)))


class Listener(Observer):
    def __init__(self) -> None:
        self.heard: list[tuple[str, Any]] = []

    def searching(self, evaluations: int, best_cost: float) -> None:
        self.heard.append(("search", evaluations))

    def experimenting(self, theta: Array, start: Array) -> None:
        self.heard.append(("begins", (theta, start)))

    def experimented(self, rollout: Rollout) -> None:
        self.heard.append(("ends", rollout))


class Impossible(Distance):
    """Every policy fails."""

    max_cost = 0.0


def scripted(study: Study, predicted: list[float], hardware: list[float], **options: Any) -> list[Iteration]:
    """Run with the costs that searches predict and experiments have, two an iteration; Z_max is 0.1875."""
    scripts = {"evaluation": ScriptedPrediction(predicted), "hardware": ScriptedHardware(hardware)}
    task = PointMass(horizon=FRAMES)
    return list(replace(study, task=task, **scripts, method=Algorithm1(**options)).run())


def test_success_ends_the_loop(point_mass: Study) -> None:
    """Lines 10-12, and Z_r is the maximum over the experiments (line 9)."""
    iterations = scripted(point_mass, [0.1] * 3, [0.9, 0.1, 0.15, 0.18, 0.0, 0.0])
    assert [i.succeeded for i in iterations] == [False, True]
    assert [i.hardware_cost for i in iterations] == pytest.approx([0.9, 0.18])
    assert [i.total_experiments for i in iterations] == [2, 4]


def test_a_trial_that_never_succeeds_makes_all_experiments(point_mass: Study) -> None:
    method = Algorithm1(max_iterations=2, experiments=3)
    assert (method.max_iterations, method.max_experiments) == (2, 6)
    (*_, last) = scripted(point_mass, [0.1] * 2, [0.9] * 6, max_iterations=2, experiments=3)
    assert last.total_experiments == 6


def test_failure_ends_after_n_out(point_mass: Study) -> None:
    """Line 3."""
    iterations = scripted(point_mass, [0.1] * 10, [0.9] * 20)
    assert [i.index for i in iterations] == list(range(10))
    assert not iterations[-1].succeeded
    assert iterations[-1].total_experiments == 20


def test_data_accumulates(point_mass: Study) -> None:
    """Line 13: D is the union of all D_i; line 14: the next search is on g_D."""
    first, second, last = scripted(point_mass, [0.1] * 3, [0.9, 0.8, 0.7, 0.6, 0.0, 0.0])
    learned = [i.learning.data.inputs for i in (first, second, last)]
    assert [len(inputs) for inputs in learned] == [10, 20, 20]  # success learns no more (line 11)
    np.testing.assert_array_equal(learned[1][:10], learned[0])
    np.testing.assert_array_equal(learned[1][10:], second.learning.selection.transitions.inputs)
    assert not predicts_something(first.search.fitted_bias)
    assert predicts_something(second.search.fitted_bias)


def test_a_bad_search_clears_the_model(point_mass: Study) -> None:
    """Lines 6-8, then line 9 all the same; D is then what line 13 adds."""
    iterations = scripted(point_mass, [0.1, 0.19, 0.1], [0.9] * 4 + [0.0] * 2)
    assert [i.learning.reset for i in iterations] == [False, True, False]
    assert [len(i.learning.data) for i in iterations] == [10, 10, 10]
    assert [len(i.experiments) for i in iterations] == [2, 2, 2]


def test_a_fall_in_the_last_frame_is_no_success(point_mass: Study) -> None:
    """Even where it costs nothing, as in Eq. 8, where c (T - t_fail) = 0."""

    class Falling(ScriptedHardware):
        def run(self, policy, theta, start, rng):
            rollout = super().run(policy, theta, start, rng)
            return replace(rollout, failed_at=rollout.frames, failure="distance")

    class Lenient(Distance):
        def of(self, rollout):
            return super().of(replace(rollout, failed_at=None))

    for hardware, succeeds in ((ScriptedHardware, True), (Falling, False)):
        study = replace(
            point_mass,
            task=PointMass(horizon=FRAMES),
            evaluation=ScriptedPrediction([0.1]),
            hardware=hardware([0.0, 0.0]),
            cost=Lenient(),
            method=Algorithm1(1),
        )
        (only,) = study.run()
        assert (only.hardware_cost, only.succeeded) == (0.0, succeeds)
        assert len(only.learning.data) == (0 if succeeds else 10)


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


def test_z_max_itself_stops_an_iteration(point_mass: Study) -> None:
    """As it is no success (line 10)."""
    at_limit = point_mass.cost.max_cost
    first, _ = scripted(point_mass, [0.1] * 2, [at_limit, 0.0, 0.0], stop_at_failure=True)
    assert len(first.experiments) == 1


def test_stopping_early_changes_no_later_start(point_mass: Study) -> None:
    """Iterations compare on common random numbers."""
    whole, stopped = (
        list(replace(point_mass, bias=no_bias(), method=Algorithm1(3, stop_at_failure=stop)).run())
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


def test_what_is_satisfactory_may_be_less_than_z_max(point_mass: Study) -> None:
    """A search that ends between the two is made again, and clears nothing if it ends there again."""
    options = {"retry_search": 1, "satisfactory_cost": 0.15}
    first, last = scripted(point_mass, [0.19, 0.18, 0.1], [0.9] * 2 + [0.0] * 2, **options)
    assert first.search.predicted_cost == 0.18
    assert first.search.optimum.stopped_by.endswith(", with no cost below 0.15, in search 2 of 2")
    assert not first.learning.reset
    assert " search " not in last.search.optimum.stopped_by


def test_after_its_last_retry_a_failed_search_is_one(point_mass: Study) -> None:
    """Lines 6-9 follow, with the best policy of all."""
    first, last = scripted(point_mass, [0.3, 0.2, 0.25, 0.1], [0.9] * 2 + [0.0] * 2, retry_search=2)
    assert first.search.predicted_cost == 0.2
    assert first.search.optimum.stopped_by.endswith(", in search 2 of 3")
    assert first.learning.reset
    assert len(first.experiments) == 2
    assert last.succeeded


class Spread(Evaluation):
    """Predicts the deviation of the models that a search draws, as its cost."""

    def objective(self, model, cost, rng):
        return lambda theta: model.nominal.deviation


class Uncertain(WithoutWind):
    """A model whose draws deviate from it."""

    deviation = 1.0

    def narrowed(self, share):
        nearer = copy(self)
        nearer.deviation = share * self.deviation
        return nearer


def test_a_search_made_again_draws_nearer_models(point_mass: Study) -> None:
    """With half of the deviations each time, until a policy holds on them; the next iteration begins anew."""
    task = PointMass(horizon=FRAMES)
    study = replace(point_mass, task=task, evaluation=Spread(), nominal=Uncertain(task))
    method = Algorithm1(2, retry_search=3, retry_spread=0.5, satisfactory_cost=0.3)
    for iteration in replace(study, method=method, hardware=ScriptedHardware([0.9] * 4)).run():
        assert iteration.search.predicted_cost == 0.25
        assert iteration.search.optimum.stopped_by.endswith(", in search 3 of 3")
    method = Algorithm1(1, retry_search=3, satisfactory_cost=0.3)
    (same,) = replace(study, method=method, hardware=ScriptedHardware([0.9] * 2)).run()
    assert same.search.predicted_cost == 1.0


def test_a_search_made_again_draws_other_numbers(point_mass: Study) -> None:
    """With an optimizer that draws, the best of three searches is as good as the first, or better."""
    impossible = replace(point_mass, cost=Impossible(), optimizer=Nlopt("GN_CRS2_LM", 50, 1e-6))
    once, thrice = (
        next(replace(impossible, method=Algorithm1(1, retry_search=retries)).run()) for retries in (0, 2)
    )
    assert thrice.search.optimum.evaluations == 3 * once.search.optimum.evaluations == 150
    assert thrice.search.predicted_cost < once.search.predicted_cost


@pytest.mark.slow
@pytest.mark.parametrize("warm", [False, True])
def test_a_warm_search_evaluates_the_earlier_policies_first(point_mass: Study, warm: bool) -> None:
    searches: list[list[np.ndarray]] = []

    class Recorded(NominalStart):
        def objective(self, model, cost, rng):
            searches.append([])
            objective = super().objective(model, cost, rng)
            return lambda theta: searches[-1].append(theta) or objective(theta)

    study = replace(
        point_mass,
        evaluation=Recorded(point_mass.task),
        bias=no_bias(),
        method=Algorithm1(3, warm_start=warm),
    )
    policies = [iteration.parameters for iteration in study.run()]
    assert len(searches) == 3
    first_evaluated = [[theta.tolist() for theta in searched[:2]] for searched in searches]
    centre = np.mean(point_mass.policy.bounds, axis=0).tolist()
    expected = [centre, policies[0].tolist(), policies[0].tolist()] if warm else [centre] * 3
    assert [evaluated[0] for evaluated in first_evaluated] == expected


def test_a_search_may_begin_with_regulators(point_mass: Study) -> None:
    evaluated: list[np.ndarray] = []

    class Recorded(NominalStart):
        def objective(self, model, cost, rng):
            objective = super().objective(model, cost, rng)
            return lambda theta: evaluated.append(theta) or objective(theta)

    study = replace(
        point_mass,
        evaluation=Recorded(point_mass.task),
        bias=no_bias(),
        policy=OutputFeedback(point_mass.task),
        method=Algorithm1(1, design=1),
    )
    list(study.run())
    expected = regulated(study.model())
    assert len(expected) > 1
    np.testing.assert_array_equal(evaluated[: len(expected)], expected)


def test_a_search_that_is_recalled_makes_no_regulators(
    point_mass: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    models: list[Model] = []
    monkeypatch.setattr(design, "regulated", lambda model: models.append(model) or regulated(model))
    study = replace(point_mass, policy=OutputFeedback(point_mass.task), method=Algorithm1(1, design=2))
    policies = [run_trial(study, Journal(tmp_path)).iterations[0].parameters for _ in range(2)]
    assert len(models) == 2
    np.testing.assert_array_equal(*policies)


def test_z_max_itself_is_no_reset_and_no_success(point_mass: Study) -> None:
    """Line 6 asks for more than Z_max, line 10 for less."""
    at_limit = point_mass.cost.max_cost
    first, _ = scripted(point_mass, [at_limit, 0.1], [at_limit, 0.0, 0.0, 0.0])
    assert not first.learning.reset
    assert not first.succeeded


@pytest.mark.slow
def test_the_bias_is_learned_and_the_policy_balances(point_mass: Study) -> None:
    """The real thing: wind that the nominal model does not know, on plain Python components."""
    blind = replace(point_mass, bias=no_bias())
    *_, last_blind = blind.run()
    iterations = list(point_mass.run())
    assert not last_blind.succeeded
    assert iterations[-1].succeeded
    assert len(iterations) > 1


@pytest.mark.slow
def test_same_seed_same_records(point_mass: Study) -> None:
    one, other = list(point_mass.run()), list(point_mass.run())
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.parameters, b.parameters)
        np.testing.assert_array_equal(a.learning.data.residuals, b.learning.data.residuals)
        assert a.hardware_cost == b.hardware_cost
    different = list(replace(point_mass, seed=1).run())
    assert different[0].experiments[0].states[0] != pytest.approx(one[0].experiments[0].states[0])


def test_hardware_draws_do_not_depend_on_the_search(point_mass: Study) -> None:
    """Another optimizer meets the same starts."""
    other = replace(point_mass, optimizer=Nlopt("GN_CRS2_LM", max_evaluations=50, relative_tolerance=1e-6))
    a, b = next(point_mass.run()), next(other.run())
    np.testing.assert_array_equal(a.experiments[0].states[0], b.experiments[0].states[0])


def test_the_observer_hears_every_experiment_before_the_record(point_mass: Study) -> None:
    listener = Listener()
    first = next(point_mass.run(listener))
    names = [name for name, _ in listener.heard]
    assert names == [*["search"] * (len(names) - 4), "begins", "ends", "begins", "ends"]
    begun = [what for name, what in listener.heard if name == "begins"]
    ended = [what for name, what in listener.heard if name == "ends"]
    assert ended == list(first.experiments)
    for (theta, start), rollout in zip(begun, ended, strict=True):
        np.testing.assert_array_equal(theta, rollout.parameters)
        np.testing.assert_array_equal(start, rollout.states[0])
    searches = [what for name, what in listener.heard if name == "search"]
    assert searches == sorted(searches)
    assert searches[-1] >= first.search.optimum.evaluations


def test_a_hardware_error_reaches_the_caller(point_mass: Study) -> None:
    class Unplugged(Hardware):
        def run(self, policy, theta, start, rng):
            raise HardwareError("no power")

    with pytest.raises(HardwareError, match="no power"):
        list(replace(point_mass, hardware=Unplugged()).run())


def no_bias():
    return NoBias()


def predicts_something(bias: FittedBias) -> bool:
    mean, _ = bias.predict(np.array([[0.9, 0.9, 0.0]]))
    return bool(mean.any())


def test_success_may_ask_for_more_passes(point_mass: Study) -> None:
    """Further experiments follow those of an iteration as long as all pass, and count."""
    hardware = [0.9, 0.0] + [0.0, 0.0, 0.9] + [0.0] * 4
    iterations = scripted(point_mass, [0.1] * 3, hardware, passes=4)
    assert [i.succeeded for i in iterations] == [False, False, True]
    assert [i.total_experiments for i in iterations] == [2, 5, 9]
    hardware = [0.9] + [0.0, 0.0, 0.9] + [0.0] * 4
    iterations = scripted(point_mass, [0.1] * 3, hardware, passes=4, stop_at_failure=True)
    assert [i.total_experiments for i in iterations] == [1, 4, 8]
    assert Algorithm1(max_iterations=3, experiments=2, passes=4).max_experiments == 12
    with pytest.raises(ValueError, match="passes: 1 are fewer than the 2 experiments"):
        Algorithm1(passes=1)
