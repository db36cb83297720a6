"""What all optimizers share: a box, finite costs, candidates, and when a search ends."""

from collections.abc import Sequence

import numpy as np
import pytest

from simbias.core import Optimizer
from simbias.core.evaluations import EVALUATION_LIMIT, STEP_LIMIT, TIME_LIMIT, Budget, Evaluations
from simbias.core.records import Array, Optimum

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
        with pytest.raises(ValueError, match=r"the cost is (nan|-?inf) at the point \["):
            minimize(lambda x, cost=cost: cost)
    budget = Budget(max_evaluations=1, relative_tolerance=1e-6)
    for lower, upper in (([0], [0]), ([1], [0]), ([0], [np.inf]), ([0, 0], [1]), ([], [])):
        with pytest.raises(ValueError, match=r"lower|bounds"):
            Evaluations(lambda x: 0.0, np.array(lower), np.array(upper), budget)


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
    budget = Budget(max_evaluations=100, relative_tolerance=1e-9)
    evaluations = Evaluations(Sphere(), *BOX, budget, target_cost=5.0)
    evaluations.evaluate(TARGET + 2.0)
    worse = evaluations.explored(lambda part: str(part.evaluate_all([TARGET + 9.0, TARGET + 8.0])), 2)
    np.testing.assert_array_equal(worse, TARGET + 8.0)
    np.testing.assert_array_equal(evaluations.start, TARGET + 2.0)
    evaluations.explored(lambda part: str(part.evaluate_all([TARGET + 1.0, TARGET])), 50)
    assert (evaluations.count, evaluations.best_cost) == (4, 3.0)
    np.testing.assert_array_equal(evaluations.start, TARGET + 1.0)
