"""Looking ahead changes how points are evaluated, never which ones are found."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simbias.config import compose
from simbias.config.build import construct
from simbias.core import Objective, Optimizer
from simbias.core.evaluations import STEP_LIMIT, TIME_LIMIT, Budget, Evaluations
from simbias.core.records import Array, Optimum
from simbias.search.optimizer.lookahead import MOST, look_ahead

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


def minimize(name: str, objective, limit: int, seed: int, **options: float) -> Optimum:
    config = compose(["tracking=none", f"optimizer={name}"]).config["optimizer"]
    optimizer = construct({**config, "max_evaluations": limit, **options}, Optimizer, "optimizer")
    rng = np.random.default_rng(seed)
    return optimizer.minimize(objective, np.full(3, -2.0), np.full(3, 2.5), rng)


@pytest.mark.slow
@pytest.mark.parametrize("name", SEARCHES)
@settings(max_examples=4, deadline=None)
@given(limit=st.integers(1, 200), seed=st.integers(0, 99), shift=st.floats(-1, 1))
def test_result_is_the_sequential_searchs(name: str, limit: int, seed: int, shift: float) -> None:
    in_turn = minimize(name, Counting(shift).cost, limit, seed)
    ahead = minimize(name, Counting(shift), limit, seed)
    np.testing.assert_array_equal(ahead.parameters, in_turn.parameters)
    assert (ahead.cost, ahead.evaluations) == (in_turn.cost, in_turn.evaluations)
    assert ahead.stopped_by == in_turn.stopped_by


@pytest.mark.parametrize(("name", "waste"), [("nlopt_direct", 0.05), ("cma", 0.0)])
def test_few_guesses_are_wrong(name: str, waste: float) -> None:
    objective = Counting()
    optimum = minimize(name, objective, 1000, 0)
    assert optimum.evaluations <= sum(objective.calls) <= (1 + waste) * optimum.evaluations + MOST
    assert len(objective.calls) < optimum.evaluations / 5


def test_a_search_that_changes_its_mind_is_noticed() -> None:
    rng = np.random.default_rng(0)

    def capricious(evaluate: Callable[[Array], float]) -> str:
        return str([evaluate(point) for point in rng.uniform(size=(100, 3))])

    budget = Budget(max_evaluations=100, relative_tolerance=1e-6)
    evaluations = Evaluations(Counting(), np.zeros(3), np.ones(3), budget)
    with pytest.raises(RuntimeError, match="other points when it is given the same costs"):
        look_ahead(capricious, evaluations)


@pytest.mark.parametrize("name", SEARCHES)
def test_a_search_ends_with_its_steps_and_in_time(name: str) -> None:
    """After the batch in which they are used up; its best point is the best of all that it counts."""
    for points, seed in ((1, 0), (60, 1), (200, 2)):
        objective = Counting()
        optimum = minimize(name, objective, 100_000, seed, max_steps=STEPS * points)
        assert objective.steps < STEPS * points + STEPS * MOST
        assert optimum.evaluations <= sum(objective.calls)
        assert optimum.cost == objective.cost(optimum.parameters)
        assert optimum.stopped_by == STEP_LIMIT if objective.steps >= STEPS * points else True
    objective = Counting()
    optimum = minimize(name, objective, 100_000, 0, max_seconds=1e-9, relative_tolerance=1e-300)
    assert optimum.stopped_by == TIME_LIMIT
    assert len(objective.calls) == 1
