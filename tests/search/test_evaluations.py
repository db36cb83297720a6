"""What all optimizers share: a box, finite costs, candidates, an end; and that they look ahead."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simbias.config import compose
from simbias.config.build import construct
from simbias.core import Objective, Optimizer
from simbias.core.evaluations import EVALUATION_LIMIT, STEP_LIMIT, TIME_LIMIT, Evaluations, SearchBudget
from simbias.core.records import Array, Optimum
from simbias.search.optimizer.cma import NO_PROGRESS
from simbias.search.optimizer.lookahead import MOST, look_ahead

TARGET = np.array([1.0, -2.0])
BOX = np.full(2, -10.0), np.full(2, 10.0)


class Uniform(Optimizer):
    """Draws points from the box."""

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        while True:
            evaluations.evaluate(rng.uniform(evaluations.lower, evaluations.upper))


class Sphere:
    """It counts a hundred steps a point."""

    def __init__(self) -> None:
        self.points: list[Array] = []

    @property
    def steps(self) -> int:
        return 100 * len(self.points)

    def __call__(self, x: Array) -> float:
        self.points.append(x)
        return 1.0 + float(np.sum((x - TARGET) ** 2))


def minimize(
    objective, candidates: Sequence[Array] = (), target_cost: float = np.inf, **budget: float
) -> Optimum:
    optimizer = Uniform(**{"max_evaluations": 30, "relative_tolerance": 1e-9, **budget})  # type: ignore[arg-type]
    return optimizer.minimize(objective, *BOX, np.random.default_rng(0), target_cost, candidates)


def test_costs_and_boxes_must_be_finite() -> None:
    for cost in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match=r"^cost: must be finite, got (nan|-?inf) for the policy \["):
            minimize(lambda x, cost=cost: cost)
    budget = SearchBudget(max_evaluations=1, relative_tolerance=1e-6)
    for lower, upper in (([0], [0]), ([1], [0]), ([0], [np.inf]), ([0, 0], [1]), ([], [])):
        with pytest.raises(ValueError, match=r"lower|bounds"):
            Evaluations(lambda x: 0.0, np.array(lower), np.array(upper), budget)


class Silent(Optimizer):
    """Proposes one point, and does not say why it ends."""

    def __init__(self, point: Array) -> None:
        self.point, self.max_evaluations, self.relative_tolerance = point, 30, 1e-9

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> Any:
        evaluations.evaluate(self.point)


def test_a_point_without_numbers_is_refused_before_it_is_simulated() -> None:
    objective = Sphere()
    with pytest.raises(ValueError, match=r"the search proposes a point with nan: \[0.0, nan\]"):
        Silent(np.array([0.0, np.nan])).minimize(objective, *BOX, np.random.default_rng(0))
    assert not objective.points


def test_a_search_has_to_say_why_it_ends() -> None:
    with pytest.raises(ValueError, match="search returned None; it has to say why"):
        Silent(TARGET).minimize(Sphere(), *BOX, np.random.default_rng(0))


def test_candidates_come_first() -> None:
    """Also those outside of the box; they count, and the best point may be one of them."""
    objective, candidates = Sphere(), [np.full(2, 3.0), TARGET, np.full(2, 12.0)]
    optimum = minimize(objective, candidates)
    np.testing.assert_array_equal(objective.points[:3], np.clip(candidates, *BOX))
    assert (optimum.cost, optimum.evaluations) == (1.0, len(objective.points))
    np.testing.assert_array_equal(optimum.parameters, TARGET)
    optimum = minimize(Sphere(), candidates, max_evaluations=2)
    assert (optimum.evaluations, optimum.stopped_by) == (2, EVALUATION_LIMIT)
    alike = [TARGET + 0.011, TARGET + 0.01]  # which is no convergence
    assert minimize(Sphere(), alike, relative_tolerance=1e-3).evaluations > 2


def test_a_search_ends_among_its_candidates() -> None:
    """They are evaluated in turn here, and the best of those that were is the optimum."""
    candidates = [TARGET + each for each in (1.0, 0.5, 0.1, 0.0, 0.2)]
    for limit, reason, evaluated in (
        ({"max_steps": 250}, STEP_LIMIT, 3),
        ({"max_seconds": 1e-9}, TIME_LIMIT, 1),
    ):
        objective = Sphere()
        optimum = minimize(objective, candidates, **limit)
        assert optimum.stopped_by == reason
        assert optimum.evaluations == len(objective.points) == evaluated
        np.testing.assert_array_equal(optimum.parameters, candidates[evaluated - 1])


def test_a_failed_search_says_so() -> None:
    """Whatever ended it; one that found a cost below the target does not."""
    failed, succeeded = (minimize(Sphere(), target_cost=target) for target in (1.0, 300.0))
    assert failed.stopped_by == f"{EVALUATION_LIMIT}, with no cost below 1"
    assert succeeded.stopped_by == EVALUATION_LIMIT


def test_an_exploration_begins_from_scratch_and_ends_at_the_target() -> None:
    """Its evaluations count, and its best point is the search's if it is better."""
    budget = SearchBudget(max_evaluations=100, relative_tolerance=1e-9)
    evaluations = Evaluations(Sphere(), *BOX, budget, target_cost=5.0)
    evaluations.evaluate(TARGET + 2.0)
    worse = evaluations.explored(lambda part: str(part.evaluate_all([TARGET + 9.0, TARGET + 8.0])), 2)
    np.testing.assert_array_equal(worse, TARGET + 8.0)
    np.testing.assert_array_equal(evaluations.start, TARGET + 2.0)
    evaluations.explored(lambda part: str(part.evaluate_all([TARGET + 1.0, TARGET])), 50)
    assert (evaluations.count, evaluations.best_cost) == (4, 3.0)
    np.testing.assert_array_equal(evaluations.start, TARGET + 1.0)


STEPS = 100
SEARCHES = ["nlopt_direct", "nlopt_crs", "cma", "hybrid"]


class Counting(Objective):
    """A rugged objective that counts; `together` as an evaluation offers it."""

    def __init__(self, shift: float = 0.0) -> None:
        self.calls: list[int] = []
        self._shift = shift

    def cost(self, x: Array) -> float:
        return float(np.sum((x - self._shift) ** 2) + 3 * np.sum(np.sin(3 * x) ** 2))

    @property
    def steps(self) -> int:
        """As if each point took STEPS of simulation."""
        return STEPS * sum(self.calls)

    def together(self, points: Array) -> Array:
        self.calls.append(len(points))
        return np.array([self.cost(point) for point in points])


def searched(name: str, objective, limit: int, seed: int, **options: float) -> Optimum:
    config = compose(["tracking=none", f"optimizer={name}"]).config["optimizer"]
    optimizer = construct({**config, "max_evaluations": limit, **options}, Optimizer, "optimizer")
    rng = np.random.default_rng(seed)
    return optimizer.minimize(objective, np.full(3, -2.0), np.full(3, 2.5), rng)


@pytest.mark.slow
@pytest.mark.parametrize("name", SEARCHES)
@settings(max_examples=4, deadline=None)
@given(limit=st.integers(1, 200), seed=st.integers(0, 99), shift=st.floats(-1, 1))
def test_result_is_the_sequential_searchs(name: str, limit: int, seed: int, shift: float) -> None:
    in_turn = searched(name, Counting(shift).cost, limit, seed)
    ahead = searched(name, Counting(shift), limit, seed)
    np.testing.assert_array_equal(ahead.parameters, in_turn.parameters)
    assert (ahead.cost, ahead.evaluations) == (in_turn.cost, in_turn.evaluations)
    assert ahead.stopped_by == in_turn.stopped_by


@pytest.mark.slow
@pytest.mark.parametrize(("name", "waste"), [("nlopt_direct", 0.05), ("cma", 0.0)])
def test_few_guesses_are_wrong(name: str, waste: float) -> None:
    objective = Counting()
    optimum = searched(name, objective, 1000, 0)
    assert optimum.evaluations <= sum(objective.calls) <= (1 + waste) * optimum.evaluations + MOST
    assert len(objective.calls) < optimum.evaluations / 5


def test_a_search_that_ends_before_it_has_judged_a_point_gives_its_start() -> None:
    """As one whose generations meet scenarios of their own: its means are what is judged."""

    class Fresh(Counting):
        fresh = True

    for limit, options, reason in ((3, {}, EVALUATION_LIMIT), (1000, {"max_seconds": 1e-9}, TIME_LIMIT)):
        optimum = searched("cma", objective := Fresh(), limit, 0, **options)
        np.testing.assert_array_equal(optimum.parameters, np.full(3, 0.25))
        assert (optimum.cost, optimum.stopped_by) == (objective.cost(optimum.parameters), reason)
        assert optimum.evaluations == sum(objective.calls)
        assert not optimum.flat


@pytest.mark.parametrize("cost", [2.0, -2.0])
def test_a_search_ends_where_means_of_generations_do_not_improve(cost: float) -> None:
    """Also where costs are below zero, as those that are declared may be."""
    rng = np.random.default_rng(0)

    class Alike(Objective):
        fresh = True

        def together(self, thetas: Array) -> Array:
            return np.full(len(thetas), cost)

        def rank(self, thetas: Array) -> Array:
            return rng.uniform(size=len(thetas))

    assert searched("cma", Alike(), 2000, 0).stopped_by == NO_PROGRESS


def test_a_search_that_changes_its_mind_is_noticed() -> None:
    rng = np.random.default_rng(0)

    def capricious(evaluate: Callable[[Array], float]) -> str:
        return str([evaluate(point) for point in rng.uniform(size=(100, 3))])

    budget = SearchBudget(max_evaluations=100, relative_tolerance=1e-6)
    evaluations = Evaluations(Counting(), np.zeros(3), np.ones(3), budget)
    with pytest.raises(RuntimeError, match="other points when it is given the same costs"):
        look_ahead(capricious, evaluations)


@pytest.mark.slow
@pytest.mark.parametrize("name", SEARCHES)
def test_a_search_ends_with_its_steps_and_in_time(name: str) -> None:
    """After the batch in which they are used up; its best point is the best of all that it counts."""
    for points, seed in ((1, 0), (60, 1), (200, 2)):
        objective = Counting()
        optimum = searched(name, objective, 100_000, seed, max_steps=STEPS * points)
        assert objective.steps < STEPS * points + STEPS * MOST
        assert optimum.evaluations <= sum(objective.calls)
        assert optimum.cost == objective.cost(optimum.parameters)
        assert optimum.stopped_by == STEP_LIMIT if objective.steps >= STEPS * points else True
    objective = Counting()
    optimum = searched(name, objective, 100_000, 0, max_seconds=1e-9, relative_tolerance=1e-300)
    assert optimum.stopped_by == TIME_LIMIT
    assert len(objective.calls) == 1
