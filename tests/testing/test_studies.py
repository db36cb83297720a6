"""What is found before a trial begins: robots at rest, boxes without zero, costs of one horizon only."""

import ctypes
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from pendulum import pendulum
from point_mass import Distance, EveryFifth, Spring, WithoutWind

import simbias
from simbias.core import Bias, Cost, Evaluation, FittedBias, Identification, Model, Nominal, Optimizer, Policy
from simbias.core.evaluations import SearchEnded
from simbias.core.parameters import Parameter
from simbias.core.records import Array, Rollout, Selection, Transitions
from simbias.testing.conformance import verdicts
from simbias.testing.expectations import ConformanceError, expect_arguments_left, rollout
from simbias.testing.studies import warm_up
from simbias.trial.study import Study

pytestmark = pytest.mark.usefixtures("uncompiled")


class Noting(Evaluation):
    """Notes the policies that it evaluates."""

    def __init__(self) -> None:
        self.thetas: list[Array] = []

    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Any:
        return self.thetas.append


class Constant(Cost):
    max_cost = 1.0

    def of(self, rollout: Rollout) -> float:
        return 2.0


def problems(study: Study, group: str) -> list[str]:
    return [verdict.problem for verdict in verdicts(study, {group}) if verdict.problem]


@pytest.mark.slow
@pytest.mark.usefixtures("plain_predictions")
def test_what_rests_without_inputs_is_warmed_up() -> None:
    """A hanging pendulum: nothing errs, so there is nothing to whiten by."""
    few = [f"identification.{each}" for each in ("starts=1", "rounds=1", "evaluations=2", "window=0.02")]
    study = pendulum("identification=posterior", "bias=window_gp", "task.horizon=60", *few)
    assert not study.simulate(np.zeros(study.policy.n_parameters)).states.any()
    warm_up(study)
    assert problems(study, "identification") == []


def test_warm_up_and_checks_keep_to_the_policys_box(
    point_mass: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In simulation, and on the hardware, which may break, and begins near the start."""
    policy, evaluation, thetas = copy(point_mass.policy), Noting(), list[Array]()
    policy.bounds = (np.full(policy.n_parameters, 0.5), policy.bounds[1])
    narrow, run = replace(point_mass, policy=policy), point_mass.hardware.run
    warm_up(replace(narrow, evaluation=evaluation))
    np.testing.assert_array_equal(evaluation.thetas, np.full((2, policy.n_parameters), 0.5))

    def noted(policy: Policy, theta: Array, *others: Any) -> Rollout:
        thetas.append(theta)
        made = run(policy, theta, *others)
        return replace(made, states=made.states + 1e-3)

    monkeypatch.setattr(narrow.hardware, "run", noted)
    assert problems(narrow, "hardware") == []
    np.testing.assert_array_equal([*thetas, rollout(narrow).parameters], 0.5)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (lambda x: np.tile(x[:1], (len(x), 1)), "to change while .* is not zero"),
        (lambda x: np.vstack([x[:1], x[1:] * [1.0, 180.0 / np.pi]]), "times as fast as"),
    ],
    ids=["one array for all frames", "a rate in another unit"],
)
def test_states_of_hardware_that_cannot_be_are_named(
    point_mass: Study, monkeypatch: pytest.MonkeyPatch, fault: Callable[[Array], Array], said: str
) -> None:
    run = point_mass.hardware.run

    def faulty(*arguments: Any) -> Rollout:
        made = run(*arguments)
        return replace(made, states=fault(made.states))

    monkeypatch.setattr(point_mass.hardware, "run", faulty)
    (problem,) = problems(point_mass, "hardware")
    assert re.search(said, problem), problem


@pytest.mark.slow
def test_a_cost_is_asked_for_the_horizon_that_an_evaluation_simulates(point_mass: Study) -> None:
    assert problems(replace(point_mass, cost=Constant()), "cost") == []
    long = ["tracking=none", "evaluation=robust", "evaluation.seconds=3"]
    longer = simbias.load([*POINT_MASS, *long], OWN_CONF)
    (problem,) = problems(replace(longer, cost=Constant()), "cost")
    assert "Constant" in problem
    assert "with_horizon" in problem


class WritesInto(Spring):
    """Twice is as once."""

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        np.minimum(x, 10.0, out=x)
        return super().act(theta, x, t, policy_state)


class Unlimited(Spring):
    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        return -0.5 * theta[..., :1] * x[..., :1], policy_state  # below its limit near the start


class WindsUp(Spring):
    """Adds an integral to what is within its limits."""

    state_size = 1

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        return super().act(theta, x, t, policy_state)[0] + policy_state, policy_state + x[..., :1]


class Mixes(Spring):
    """Lets rollouts that run together share their mean memory."""

    state_size = 1

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        shared = np.mean(policy_state, axis=tuple(range(x.ndim - 1)), keepdims=True)
        return super().act(theta, x, t, policy_state)[0], 0.0 * policy_state + shared + x[..., :1]


class InputsOnly(Spring):
    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> Any:
        return super().act(theta, x, t, policy_state)[0]


class Searches(Optimizer):
    """Draws points from the box."""

    def __init__(self, points: Callable[[Any, Any], Any]) -> None:
        self._points, self.max_evaluations, self.relative_tolerance = points, 2000, 1e-3

    def search(self, evaluations: Any, rng: np.random.Generator) -> str:
        while True:
            self._points(evaluations, rng)


def without_seed(evaluations: Any, rng: Any) -> None:
    evaluations.evaluate(np.random.default_rng().uniform(-1.0, 1.0, 2))


def far_away(evaluations: Any, rng: Any) -> None:
    evaluations.evaluate(rng.uniform(-1.0, 0.1, 2))


def at_any_cost(evaluations: Any, rng: Any) -> None:
    with suppress(Exception):
        evaluations.evaluate(rng.uniform(-1.0, 1.0, 2))
    if evaluations.remaining == 0:
        raise SearchEnded("all spent")


class Directed(Spring):
    """Has one direction, the same for any policy."""

    def __init__(self, task: Any, *direction: float) -> None:
        super().__init__(task)
        self._direction = direction

    def directions(self, theta: Array) -> Array:
        return np.array([self._direction])


class Fits(Identification):
    def __init__(self, fit: Callable[[Any, Sequence[Rollout]], Any]) -> None:
        self._fit = fit

    def fit(self, nominal: Nominal, rollouts: Sequence[Rollout]) -> Nominal:
        return self._fit(nominal, rollouts)


def twice_as_heavy(nominal: Any, rollouts: Sequence[Rollout]) -> Any:
    other = copy(nominal)
    other._mass *= 2.0
    return other


def roughly(nominal: Any, rollouts: Sequence[Rollout]) -> Any:
    other = copy(nominal)
    other._mass *= np.random.default_rng().normal(1.0, 0.01) if rollouts else 1.0
    return other


def smoothing(nominal: Any, rollouts: Sequence[Rollout]) -> Any:
    for each in rollouts:
        each.states[1:] = (each.states[1:] + each.states[:-1]) / 2
    return nominal


def heavier(nominal: Any, rollouts: Sequence[Rollout]) -> Any:
    if rollouts:
        nominal._mass *= 1.5
    return nominal


class Picks(EveryFifth):
    """Residuals of the row before, or none: the next states."""

    def __init__(self, residuals: Callable[[Transitions], Array]) -> None:
        self._residuals = residuals

    def select(self, rollouts: Sequence[Rollout], nominal: Nominal) -> Selection:
        selection = super().select(rollouts, nominal)
        data = selection.transitions
        return replace(selection, transitions=Transitions(data.inputs, self._residuals(data)))


class Remembers(Distance):
    seen = 0

    def of(self, rollout: Rollout) -> float:
        self.seen += 1
        return super().of(rollout) + self.seen


class Jerk(Cost):
    """Keeps the last input where it is asked for one frame after the other, or for many."""

    max_cost, horizon, time_step, reductions, last = 1.0, 100, 0.02, ("sum",), 0.0

    def terms(self, x_next: Array, u: Array, t: Any) -> Array:
        jump, self.last = np.abs(u[..., :1] - self.last), u[..., :1]
        return jump

    def of_totals(self, totals: Array, lost: Any) -> Array:
        return totals[..., 0] + 100.0 * lost


class OneTerm(Jerk):
    """Takes the first rollout's total for all rollouts'."""

    def terms(self, x_next: Array, u: Array, t: Any) -> Array:
        return np.square(x_next[..., :1])

    def of_totals(self, totals: Array, lost: Any) -> Array:
        return totals[0] + 100.0 * lost


class Root(Jerk):
    def terms(self, x_next: Array, u: Array, t: Any) -> Array:
        return np.sqrt(x_next[..., :1])

    def of_totals(self, totals: Array, lost: Any) -> Array:
        return totals[..., 0] + 100.0 * lost


class TwoTerms(Root):
    def terms(self, x_next: Array, u: Array, t: Any) -> Array:
        return np.square(x_next[..., :2])


class DrawsAgain(Evaluation):
    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Any:
        return lambda theta: rng.random()


class Clips(Distance):
    def of(self, rollout: Rollout) -> float:
        np.clip(rollout.states, -10.0, 10.0, out=rollout.states)
        return super().of(rollout)


class Parametrised(WithoutWind):
    """Takes its two parameters for each other."""

    def __init__(self, task: Any, mass: float = 2.0, of_cart: float = 1.0) -> None:
        super().__init__(task, mass + 2 * of_cart)
        self._task, self._has = task, np.array([mass, of_cart])
        self.parameters = (Parameter("mass", "kg", mass, 0.1), Parameter("of_cart", "kg", of_cart, 0.1))

    def with_parameters(self, values: Array) -> Nominal:
        return Parametrised(self._task, *values[::-1])


class Elsewhere(Parametrised):
    """Does so but for the declared values."""

    def with_parameters(self, values: Array) -> Nominal:
        declared = [parameter.value for parameter in self.parameters]
        return self if values.tolist() == declared else super().with_parameters(values)


class Multiplies(Parametrised):
    """Takes its values for multiples of those that it has."""

    def with_parameters(self, values: Array) -> Nominal:
        declared = np.array([parameter.value for parameter in self.parameters])
        other = Multiplies(self._task, *self._has * values / declared)
        other.parameters = self.parameters
        return other


class Twins(WithoutWind):
    parameters = (Parameter("mass", "kg", 1.0, 0.1), Parameter("mass", "kg", 1.0, 0.1))


class Zero(WithoutWind):
    parameters = (Parameter("buoyancy", "N", 0.0, 0.1, "log_normal"),)


BROKEN: list[tuple[str, Callable[[Any], Any], str]] = [
    ("policy", WritesInto, "WritesInto.act: expected its arguments to be left as they are"),
    ("policy", Unlimited, "Unlimited.act: expected inputs within [-5.] and [5.]"),
    ("policy", WindsUp, "WindsUp.act: expected inputs within [-5.] and [5.], got [["),
    ("policy", Mixes, "Mixes.act: expected for several points what it gives for each"),
    ("policy", lambda task: Directed(task, 1.0), "Directed.directions: expected shape (d, 3), got (1, 1)"),
    ("policy", lambda task: Directed(task, 1.0, np.inf, 0.0), "Directed.directions: expected finite numbers"),
    ("policy", lambda task: Directed(task, 0.0, 0.0, 0.0), "Directed.directions: expected no row of zeros"),
    ("nominal", Parametrised, "Parametrised.with_parameters: expected the model itself"),
    ("nominal", Elsewhere, "Elsewhere.with_parameters: expected parameters of values [2.01"),
    ("nominal", Multiplies, "Multiplies.with_parameters: expected the same model of the same values again"),
    ("nominal", Twins, "Twins.parameters: expected different names, got ['mass', 'mass']"),
    ("nominal", Zero, "Zero.parameters: expected buoyancy other than 0, log-normal, got 0.0"),
    ("identification", lambda _: Fits(lambda *_: None), "Fits.fit: expected a nominal model, got None"),
    ("identification", lambda _: Fits(twice_as_heavy), "Fits.fit: expected the nominal model's steps"),
    ("identification", lambda _: Fits(heavier), "Fits.fit: expected the nominal model to be left as it is"),
    ("identification", lambda _: Fits(roughly), "Fits.fit: expected the same model from the same rollouts"),
    ("identification", lambda _: Fits(smoothing), "Fits.fit: expected a result, got ValueError: assignment"),
    ("policy", InputsOnly, "InputsOnly.act: expected inputs and the policy state, got one ndarray"),
    ("optimizer", lambda _: Searches(without_seed), "Searches.search: expected the same points from the"),
    ("optimizer", lambda _: Searches(far_away), "Searches.search: expected a point within 0.2"),
    ("optimizer", lambda _: Searches(at_any_cost), "Searches.search: expected the objective's exception"),
    ("bias", lambda _: Learner(lambda _: None), "Learner.fit: expected a FittedBias, got None"),
    ("bias", lambda _: Learner(lambda _: Opposite(1.0, 0.0)), "Learner.correction: expected the sign of"),
    ("cost", lambda _: Root(), "Root.terms: expected numbers in states that do not fail, got nan"),
    ("cost", lambda _: TwoTerms(), "TwoTerms.of: expected a result, got ValueError: terms: expected shape ("),
    ("bias", lambda _: LearnsRoughly(), "LearnsRoughly.learn: expected the same from the same experiments"),
    ("samples", lambda _: Picks(lambda data: data.residuals + 1.0), "Picks.select: expected residuals x"),
    ("samples", lambda _: Picks(lambda data: np.roll(data.residuals, 1)), "Picks.select: expected residuals"),
    ("cost", lambda _: Clips(), "Clips.of: expected its arguments to be left as they are"),
    ("cost", lambda _: Remembers(), "Remembers.of: expected 2.49993"),
    ("cost", lambda _: Jerk(), "Jerk.terms: expected the same shape for each point"),
    ("cost", lambda _: OneTerm(), "OneTerm.of_totals: expected for several points what it gives for each"),
    ("evaluation", lambda _: DrawsAgain(), "DrawsAgain.objective: expected the same when it is asked again"),
]


def test_what_breaks_a_contract_is_told(point_mass: Study) -> None:
    for group, component, problem in BROKEN:
        nominal = copy(point_mass.nominal)  # which one of them changes
        broken = replace(point_mass, **{"nominal": nominal, group: component(point_mass.task)})
        first, *_ = problems(broken, group)
        assert first.startswith(problem)


class LearnsRoughly(Bias):
    def fit(self, transitions: Transitions) -> FittedBias:
        return Adds(0.0, 0.0)

    def learn(self, transitions: Transitions, rollouts: Sequence[Rollout], nominal: Nominal) -> FittedBias:
        return Adds(*np.random.default_rng().normal(size=2))


class Adds(FittedBias):
    """Adds the same to any state."""

    def __init__(self, *added: float) -> None:
        self._added = added

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        return np.tile(self._added, (len(inputs), 1)), np.zeros((len(inputs), len(self._added)))

    def correction(self, x: Array, u: Array) -> Array:
        return np.zeros((*x.shape[:-1], 1)) + self._added


class Opposite(Adds):
    """Takes away what it predicts."""

    def correction(self, x: Array, u: Array) -> Array:
        return -super().correction(x, u)


def zeroes(data: Transitions) -> FittedBias:
    data.residuals[:] = 0.0
    return Adds(0.0, 0.0)


class Learner(Bias):
    """Gives zero without data."""

    def __init__(self, learned: Callable[[Transitions], Any]) -> None:
        self._learned = learned

    def fit(self, transitions: Transitions) -> FittedBias:
        return self._learned(transitions) if len(transitions) else Adds(0.0, 0.0)


LEARNED: list[tuple[Callable[[Transitions], Any], str]] = [
    (lambda data: None, r"Learner.fit: expected a FittedBias, got None \(test_studies.py:\d+\)"),
    (lambda data: Adds(np.nan, 0.0), r"Adds.correction: expected finite numbers, got nan \(test_.*\)"),
    (lambda data: Adds(0.0), r"Adds.correction: expected the shape \(2, 2\), got \(2, 1\) \(test_.*\)"),
    (zeroes, ".* is read-only"),
]


def test_a_learner_that_breaks_its_contract_is_told_before_a_trial(point_mass: Study) -> None:
    for learned, problem in LEARNED:
        broken = replace(point_mass, bias=Learner(learned))
        with pytest.raises(ValueError, match=f"^{problem}$"):
            warm_up(broken)
        assert problems(broken, "bias")


def test_writes_are_told_that_raise_nothing_or_in_other_words() -> None:
    def by_pointer(x: Array) -> None:
        ctypes.memset(x.ctypes.data, 0, x.nbytes)

    for method in (by_pointer, np.random.default_rng(0).shuffle):
        with pytest.raises(ConformanceError, match="its arguments to be left as they are"):
            expect_arguments_left(method, "method", np.arange(5.0))


class Failing(Noting):
    """Predicts that every policy fails."""

    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Any:
        def predicted(theta: Array) -> float:
            self.thetas.append(theta)
            return 2 * cost.max_cost

        return predicted


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [[], ["method=ideal"], ["method=multi_fidelity", "+hardware@method.middle=point_mass"]]
)
def test_a_method_is_checked_by_a_short_trial_that_moves_nothing(
    method: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long its own are: on a model of many contacts they take minutes."""
    long = ["bias=none", "optimizer=nlopt_crs", "optimizer.max_evaluations=100000"]
    real = ["hardware.confirm=true", "policy_test.episodes=3", "tracking=none", *method]
    study, evaluation = simbias.load([*POINT_MASS, *long, *real], OWN_CONF), Failing()
    monkeypatch.setattr(type(study.hardware), "run", pytest.fail)
    monkeypatch.setattr("simbias.trial.run.run_policy_test", tested := Mock(return_value=None))
    assert problems(replace(study, evaluation=evaluation), "method") == []
    assert {call.args[2].episodes for call in tested.call_args_list} == {0}
    assert len(evaluation.thetas) < 1000
    assert evaluation.thetas or method == ["method=ideal"]  # which searches on hardware alone
