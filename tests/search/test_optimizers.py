"""Every optimizer of conf/optimizer, and every algorithm of NLopt's that may be named there."""

from __future__ import annotations

import gc
import importlib
import subprocess
import sys
from collections.abc import Callable
from typing import Any, get_args

import numpy as np
import pytest
from conftest import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from simbias.core import Optimizer
from simbias.core.evaluations import EVALUATION_LIMIT, RELATIVE_TOLERANCE, Evaluations
from simbias.core.records import Array, Optimum
from simbias.search.optimizer.cma import Cma
from simbias.search.optimizer.hybrid import Hybrid
from simbias.search.optimizer.nlopt import Algorithm, Nlopt
from simbias.search.optimizer.scipy import ScipyDirect

SHIPPED = sorted(path.stem for path in (ROOT / "conf" / "optimizer").glob("*.yaml"))
RANDOM = [name for name in SHIPPED if "direct" not in name]
DETERMINISTIC = [name for name in get_args(Algorithm) if "DIRECT" in name and "RAND" not in name]

Make = Callable[..., Optimizer]


def written(name: str) -> dict[str, Any]:
    """What a YAML says, after those that it goes on from."""
    config: Any = OmegaConf.to_container(OmegaConf.load(ROOT / "conf" / "optimizer" / f"{name}.yaml"))
    before = [written(other) for other in config.pop("defaults", []) if other != "_self_"]
    return {key: value for each in [*before, config] for key, value in each.items()}


def shipped(name: str) -> Make:
    """What makes the optimizer of a YAML, some of its arguments changed."""
    config = written(name)
    module, _, class_name = config.pop("_target_").rpartition(".")
    return lambda **changes: getattr(importlib.import_module(module), class_name)(**{**config, **changes})


def named(algorithm: Algorithm) -> Make:
    """What makes the optimizer of one of NLopt's algorithms."""
    return lambda max_evaluations=1000, relative_tolerance=1e-6: Nlopt(
        algorithm, max_evaluations, relative_tolerance
    )


EVERY = [pytest.param(shipped(name), id=name) for name in SHIPPED]
EVERY += [pytest.param(named(name), id=name) for name in get_args(Algorithm)]
EVERY += [
    pytest.param(lambda **changes: shipped("scipy_direct")(locally_biased=True, **changes), id="scipy_l")
]
REFINING = [name for name in SHIPPED if name != "sobol"]  # whose improvements get ever smaller
refining = pytest.mark.parametrize("make", [shipped(name) for name in REFINING], ids=REFINING)
each_shipped = pytest.mark.parametrize("make", [shipped(name) for name in SHIPPED], ids=SHIPPED)
every = pytest.mark.parametrize("make", EVERY)

SHIFT = np.array([1.2, -3.4, 5.6, -7.8, 2.2])
HARTMANN_A = np.array(
    [
        [10.0, 3.0, 17.0, 3.5, 1.7, 8.0],
        [0.05, 10.0, 17.0, 0.1, 8.0, 14.0],
        [3.0, 3.5, 1.7, 10.0, 17.0, 8.0],
        [17.0, 8.0, 0.05, 10.0, 0.1, 14.0],
    ]
)
HARTMANN_P = 1e-4 * np.array(
    [
        [1312, 1696, 5569, 124, 8283, 5886],
        [2329, 4135, 8307, 3736, 1004, 9991],
        [2348, 1451, 3522, 2883, 3047, 6650],
        [4047, 8828, 8732, 5743, 1091, 381],
    ]
)


def sphere(x: Array) -> float:
    return 1.0 + float(np.sum((x - SHIFT) ** 2))


def branin(x: Array) -> float:
    """Dixon and Szego, Towards Global Optimisation 2 (1978), p. 1."""
    curve = x[1] - 5.1 / (4 * np.pi**2) * x[0] ** 2 + 5 / np.pi * x[0] - 6
    return float(curve**2 + 10 * (1 - 1 / (8 * np.pi)) * np.cos(x[0]) + 10)


def hartmann6(x: Array) -> float:
    """Dixon and Szego, as Branin's."""
    squares = np.sum(HARTMANN_A * (x - HARTMANN_P) ** 2, axis=1)
    return -float(np.array([1.0, 1.2, 3.0, 3.2]) @ np.exp(-squares))


def rosenbrock(x: Array) -> float:
    """Rosenbrock, The Computer Journal 3 (1960), p. 175."""
    return float(100 * (x[1] - x[0] ** 2) ** 2 + (1 - x[0]) ** 2)


# objective, lower, upper, minimum as in Surjanovic and Bingham, https://www.sfu.ca/~ssurjano/optimization.html
PROBLEMS = {
    "sphere": (sphere, [-10.0] * 5, [10.0] * 5, 1.0),
    "branin": (branin, [-5.0, 0.0], [10.0, 15.0], 0.397887),
    "hartmann6": (hartmann6, [0.0] * 6, [1.0] * 6, -3.32237),
    "rosenbrock": (rosenbrock, [-5.0] * 2, [10.0] * 2, 0.0),
}


def minimize(
    optimizer: Optimizer, objective: Callable[[Array], float], lower: Any, upper: Any, seed: int = 0
) -> Optimum:
    return optimizer.minimize(objective, np.array(lower), np.array(upper), np.random.default_rng(seed))


@pytest.mark.parametrize("problem", PROBLEMS)
@pytest.mark.parametrize("name", [name for name in SHIPPED if "direct" in name])
def test_direct_finds_known_minimum(name: str, problem: str) -> None:
    objective, lower, upper, minimum = PROBLEMS[problem]
    optimum = minimize(shipped(name)(max_evaluations=6000, relative_tolerance=1e-12), objective, lower, upper)
    assert optimum.cost == pytest.approx(minimum, rel=1e-4, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "problem", "at_least"),
    [
        ("cma", "sphere", 5),
        ("cma", "branin", 5),
        ("cma", "rosenbrock", 5),
        ("cma", "hartmann6", 2),  # its second-best minimum, -3.2032, has a wide basin
        ("bipop_cma", "hartmann6", 2),
        ("hybrid", "sphere", 5),
        ("hybrid", "branin", 5),
        ("hybrid", "rosenbrock", 5),
        ("hybrid", "hartmann6", 2),
        ("nlopt_crs", "sphere", 5),
        ("nlopt_crs", "branin", 4),  # a chance improvement below the tolerance ends CRS2 early
    ],
)
def test_random_search_finds_known_minimum(name: str, problem: str, at_least: int) -> None:
    """In so many of 5 seeds."""
    objective, lower, upper, minimum = PROBLEMS[problem]
    optimizer = shipped(name)(max_evaluations=6000, relative_tolerance=1e-9)
    costs = [minimize(optimizer, objective, lower, upper, seed).cost for seed in range(5)]
    assert sum(cost == pytest.approx(minimum, rel=1e-4, abs=1e-4) for cost in costs) >= at_least


@pytest.mark.parametrize(("problem", "published"), [("branin", 195), ("hartmann6", 571)])
def test_direct_needs_the_published_number_of_evaluations(problem: str, published: int) -> None:
    """Until within 0.01%: Jones, Perttunen and Stuckman, J. Optim. Theory Appl. 79 (1993), p. 157.

    They count whole divisions, here the evaluation itself is counted.
    """
    objective, lower, upper, minimum = PROBLEMS[problem]
    costs: list[float] = []

    def recorded(x: Array) -> float:
        costs.append(objective(x))
        return costs[-1]

    minimize(Nlopt("GN_ORIG_DIRECT", 1000, 1e-9), recorded, lower, upper)
    reached = next(i for i, cost in enumerate(costs, 1) if cost - minimum < 1e-4 * abs(minimum))
    assert 0.97 * published < reached <= published


class Watched:
    """An objective that remembers what it was asked, and changes its argument as it may."""

    def __init__(self, objective: Callable[[Array], float]) -> None:
        self.objective = objective
        self.points: list[Array] = []
        self.costs: list[float] = []

    def __call__(self, x: Array) -> float:
        self.points.append(x.copy())
        self.costs.append(self.objective(x))
        x[:] = np.nan
        return self.costs[-1]


def global_state() -> str:
    return str(np.random.get_state(legacy=False))  # noqa: NPY002


@st.composite
def boxes(draw: st.DrawFn) -> tuple[Array, Array, Array]:
    """A box of 1 to 4 dimensions and a point that may lie on its faces or outside."""
    n = draw(st.integers(1, 4))
    lower = np.array(draw(st.lists(st.floats(-1e3, 1e3), min_size=n, max_size=n)))
    width = np.array(draw(st.lists(st.floats(1e-3, 1e3), min_size=n, max_size=n)))
    target = lower + width * draw(st.lists(st.floats(-0.2, 1.2), min_size=n, max_size=n))
    return lower, lower + width, target


@every
@settings(max_examples=8, deadline=None)
@given(box=boxes(), limit=st.integers(1, 150), seed=st.integers(0, 2**32))
def test_contract(make: Make, box: tuple[Array, Array, Array], limit: int, seed: int) -> None:
    lower, upper, target = box
    watched = Watched(lambda x: float(np.sum(((x - target) / (upper - lower)) ** 2)))
    before = global_state()
    optimum = make(max_evaluations=limit).minimize(watched, lower, upper, np.random.default_rng(seed))
    assert optimum.evaluations == len(watched.costs) <= limit
    assert all((lower <= x).all() and (x <= upper).all() for x in watched.points)
    assert optimum.cost == min(watched.costs)
    assert optimum.parameters.tolist() == watched.points[int(np.argmin(watched.costs))].tolist()
    assert optimum.stopped_by
    assert optimum.evaluations == limit or optimum.stopped_by != EVALUATION_LIMIT
    assert global_state() == before


@every
def test_same_seed_same_optimum(make: Make) -> None:
    first, second, other = (Watched(sphere) for _ in range(3))
    for watched, seed in ((first, 3), (second, 3), (other, 4)):
        minimize(make(max_evaluations=200), watched, [-10.0] * 5, [10.0] * 5, seed)
    assert np.array_equal(first.points, second.points)
    optimizer = make()
    deterministic = isinstance(optimizer, ScipyDirect) or (
        isinstance(optimizer, Nlopt) and optimizer._algorithm in [*DETERMINISTIC, "GN_AGS"]
    )
    if deterministic:
        assert np.array_equal(first.points, other.points)


@pytest.mark.parametrize("name", RANDOM)
def test_other_seed_other_points(name: str) -> None:
    optima = [
        minimize(shipped(name)(max_evaluations=700), sphere, [-10.0] * 5, [10.0] * 5, seed) for seed in (0, 1)
    ]
    assert not np.array_equal(optima[0].parameters, optima[1].parameters)


@every
@pytest.mark.parametrize(
    "error", [RuntimeError("broken"), KeyboardInterrupt(), SystemExit(3), StopIteration()]
)
@pytest.mark.parametrize("evaluation", [1, 2, 8])
def test_exception_reaches_the_caller(make: Make, error: BaseException, evaluation: int) -> None:
    calls = []

    def failing(x: Array) -> float:
        calls.append(x)
        if len(calls) >= evaluation:
            raise error
        return sphere(x)

    with pytest.raises(type(error)) as caught:
        minimize(make(), failing, [-10.0] * 5, [10.0] * 5)
    assert caught.value is error
    assert len(calls) == evaluation


@every
@pytest.mark.parametrize("cost", [np.nan, np.inf, -np.inf])
def test_cost_must_be_finite(make: Make, cost: float) -> None:
    with pytest.raises(ValueError, match=r"the cost is (nan|-?inf) at the point \["):
        minimize(make(), lambda x: cost, [0.0] * 2, [1.0] * 2)


@every
@pytest.mark.parametrize(
    ("lower", "upper"), [([0.0], [0.0]), ([1.0], [0.0]), ([0.0], [np.inf]), ([0.0] * 2, [1.0]), ([], [])]
)
def test_box_must_be_finite_and_not_empty(make: Make, lower: list[float], upper: list[float]) -> None:
    with pytest.raises(ValueError, match=r"lower|bounds"):
        minimize(make(), lambda x: 0.0, lower, upper)


@refining
def test_relative_tolerance_stops(make: Make) -> None:
    coarse, fine = (
        minimize(make(max_evaluations=5000, relative_tolerance=tolerance), branin, [-5.0, 0.0], [10.0, 15.0])
        for tolerance in (1e-2, 1e-7)
    )
    assert coarse.stopped_by == fine.stopped_by == RELATIVE_TOLERANCE
    assert coarse.evaluations < fine.evaluations < 5000
    assert fine.cost <= coarse.cost


@pytest.mark.parametrize("name", [name for name in SHIPPED if "direct" in name])
def test_direct_does_not_end_where_nothing_improves(name: str) -> None:
    """Only an improvement that is small ends it."""
    flat = minimize(shipped(name)(max_evaluations=100), lambda x: 7.0, [-10.0] * 5, [10.0] * 5)
    assert (flat.cost, flat.evaluations, flat.stopped_by) == (7.0, 100, EVALUATION_LIMIT)


@refining
def test_only_a_small_improvement_ends_it(make: Make) -> None:
    watched = Watched(branin)
    optimum = minimize(make(relative_tolerance=1e-3), watched, [-5.0, 0.0], [10.0, 15.0])
    best = np.minimum.accumulate(watched.costs)
    before = best[np.flatnonzero(np.diff(best))[-1]]
    assert optimum.stopped_by == RELATIVE_TOLERANCE
    assert 0 < before - best[-1] < 1e-3 * abs(best[-1])


@each_shipped
def test_a_plateau_of_failures_is_no_convergence(make: Make) -> None:
    """Costs near 7e5 that differ by thousandths, as those of Eq. 8 where all policies fall."""
    plateau = lambda x: 7e5 + 1e-3 * sphere(x)  # noqa: E731
    box = np.full(5, -10.0), np.full(5, 10.0)
    ended = make().minimize(plateau, *box, np.random.default_rng(0))
    went_on = make().minimize(plateau, *box, np.random.default_rng(0), satisfactory=200.0)
    assert ended.stopped_by == RELATIVE_TOLERANCE
    assert went_on.stopped_by != RELATIVE_TOLERANCE
    assert ended.evaluations < went_on.evaluations


@each_shipped
def test_flat_objective(make: Make) -> None:
    optimum = minimize(make(max_evaluations=100), lambda x: 7.0, [-10.0] * 5, [10.0] * 5)
    assert optimum.cost == 7.0


def test_unknown_algorithm_lists_the_known() -> None:
    with pytest.raises(ValueError, match="GN_DIRECT_L, GN_DIRECT_L_RAND"):
        Nlopt("LD_MMA", 10, 1e-6)  # type: ignore[arg-type]


def test_too_many_parameters_for_an_algorithm() -> None:
    with pytest.raises(ValueError, match="GN_AGS cannot take 11 parameters"):
        minimize(Nlopt("GN_AGS", 10, 1e-6), lambda x: 0.0, [0.0] * 11, [1.0] * 11)


def test_every_algorithm_named_is_nlopts() -> None:
    import nlopt

    assert {name for name in dir(nlopt) if name.startswith("GN_")} == set(get_args(Algorithm))


@pytest.mark.slow
def test_cma_is_silent_and_writes_nothing(tmp_path: Any) -> None:
    (tmp_path / "cma_signals.in").write_text("{'maxiter': 1}")
    code = (
        "import numpy as np; from simbias.search.optimizer.cma import Cma; rng = np.random.default_rng(0);"
        "f = lambda x: float(1e6 * (x[0] > 0) + np.sum(x ** 2));"
        "o = Cma(0.25, None, 1000, 1e-6).minimize(f, -np.ones(5), np.ones(5), rng);"
        "assert o.evaluations > 100"
    )
    ran = subprocess.run(
        [sys.executable, "-W", "always", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert (ran.stdout, ran.stderr) == ("", "")
    assert [path.name for path in tmp_path.iterdir()] == ["cma_signals.in"]


@every
def test_candidates_come_first(make: Make) -> None:
    """Also those outside of the box; they count, and the best point may be one of them."""
    watched = Watched(sphere)
    candidates = [np.full(5, 3.0), SHIFT, np.full(5, 12.0)]
    optimum = make(max_evaluations=30).minimize(
        watched, np.full(5, -10.0), np.full(5, 10.0), np.random.default_rng(0), candidates=candidates
    )
    np.testing.assert_array_equal(watched.points[:3], np.clip(candidates, -10.0, 10.0))
    assert (optimum.cost, optimum.evaluations) == (sphere(SHIFT), len(watched.costs))
    np.testing.assert_array_equal(optimum.parameters, SHIFT)


@every
@pytest.mark.parametrize("limit", [1, 2])
def test_candidates_within_the_limit(make: Make, limit: int) -> None:
    watched = Watched(sphere)
    optimum = make(max_evaluations=limit).minimize(
        watched, np.full(5, -10.0), np.full(5, 10.0), np.random.default_rng(0), candidates=[SHIFT, SHIFT + 1]
    )
    assert (len(watched.costs), optimum.stopped_by) == (limit, EVALUATION_LIMIT)


@each_shipped
def test_candidates_that_are_alike_are_no_convergence(make: Make) -> None:
    watched = Watched(sphere)
    make(max_evaluations=30, relative_tolerance=1e-3).minimize(
        watched,
        np.full(5, -10.0),
        np.full(5, 10.0),
        np.random.default_rng(0),
        candidates=[SHIFT + 0.011, SHIFT + 0.01],
    )
    assert len(watched.costs) > 2


def narrow(x: Array) -> float:
    """Below 200 only near a point, elsewhere a plateau of failures as Eq. 8's: 200 for each lost frame."""
    distance = float(np.linalg.norm(x - SHIFT))
    return 1.0 + distance**2 if distance < 1.0 else 200.0 * np.ceil(100 * distance)


@pytest.mark.parametrize("name", ["cma", "bipop_cma", "hybrid"])
def test_local_search_starts_from_the_best_candidate(name: str) -> None:
    """The centre of 200 points is nearer to it than the box's centre, and the search converges there."""
    watched = Watched(narrow)
    make = shipped(name)(initial_deviation=0.01, max_evaluations=202)
    candidates = [np.full(5, -9.0), SHIFT + 0.3]
    optimum = make.minimize(
        watched, np.full(5, -10.0), np.full(5, 10.0), np.random.default_rng(0), 200.0, candidates
    )
    np.testing.assert_allclose(np.mean(watched.points[2:], axis=0), SHIFT, atol=0.3)
    assert optimum.cost < narrow(SHIFT + 0.3)


def two_valleys(x: Array) -> float:
    """Failures but for a narrow valley; a wide one of failures leads away from it."""
    wide = 1000.0 + 200.0 * np.ceil(10 * np.linalg.norm(x - 4.0))
    distance = float(np.linalg.norm(x + 7.0))
    return 1.0 + distance**2 if distance < 4.0 else float(wide)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "at_least"), [("bipop_cma", 5), ("hybrid", 5)])
def test_restarts_leave_a_valley_of_failures(name: str, at_least: int) -> None:
    """In so many of 5 seeds, where CMA-ES alone finds the way out in none."""

    def satisfied(chosen: str) -> int:
        optimizer = shipped(chosen)(max_evaluations=6000)
        box = np.full(3, -10.0), np.full(3, 10.0)
        optima = [optimizer.minimize(two_valleys, *box, np.random.default_rng(s), 200.0) for s in range(5)]
        return sum(optimum.cost < 2.0 for optimum in optima)

    assert satisfied("cma") == 0
    assert satisfied(name) >= at_least


def test_hybrid_turns_local_once_satisfied() -> None:
    """From the first satisfactory point on, it stays near the best one."""
    watched = Watched(narrow)
    optimizer = Hybrid("GN_CRS2_LM", 3000, 0.01, None, 0.001, 4000, 1e-6)
    optimum = optimizer.minimize(
        watched, np.full(5, -10.0), np.full(5, 10.0), np.random.default_rng(0), satisfactory=200.0
    )
    first = next(i for i, cost in enumerate(watched.costs) if cost < 200.0)
    after = np.linalg.norm(np.array(watched.points[first:]) - watched.points[first], axis=1)
    assert 10 < first < 3000
    assert optimum.stopped_by == RELATIVE_TOLERANCE
    assert optimum.cost == pytest.approx(1.0, abs=1e-3)
    assert np.max(after) < 2.0


def test_hybrid_may_begin_near_a_candidate_that_fails() -> None:
    """With a deviation for that: it goes down the plateaus; else it explores."""

    def distances(candidate_deviation: float | None) -> Array:
        watched, candidate = Watched(narrow), SHIFT + 1.0
        optimizer = Hybrid("sobol", 300, 0.25, 8, 0.01, 40, 1e-6, None, None, candidate_deviation)
        box = np.full(5, -10.0), np.full(5, 10.0)
        optimizer.minimize(watched, *box, np.random.default_rng(0), 200.0, [candidate])
        return np.linalg.norm(np.array(watched.points[1:]) - candidate, axis=1)

    assert distances(0.01).max() < 3.0 < np.median(distances(None))


@each_shipped
def test_a_failed_search_says_so(make: Make) -> None:
    """Whatever ended it; one that found a satisfactory cost does not."""
    failed, succeeded = (
        make(max_evaluations=300).minimize(
            lambda x, cost=cost: cost + sphere(x),
            np.full(5, -10.0),
            np.full(5, 10.0),
            np.random.default_rng(0),
            200.0,
        )
        for cost in (1e6, 0.0)
    )
    assert failed.stopped_by.endswith(", with no cost below 200")
    assert succeeded.cost < 200.0
    assert "no cost" not in succeeded.stopped_by


def test_cma_starts_at_the_centre() -> None:
    watched = Watched(sphere)
    minimize(Cma(0.001, 40, 40, 1e-6), watched, [0.0] * 5, [10.0] * 5)
    assert np.mean(watched.points, axis=0) == pytest.approx([5.0] * 5, abs=0.01)


class Together:
    """A sphere whose points may be asked for at once; it is looked ahead."""

    def __call__(self, theta: Array) -> float:
        return float(np.sum(theta**2))

    def together(self, thetas: Array) -> Array:
        return np.sum(thetas**2, axis=1)


@pytest.mark.slow
def test_searches_leave_nothing_behind() -> None:
    """NLopt holds what it calls where the garbage collector does not see it: it must not hold a search."""
    optimizer = Nlopt("GN_DIRECT", 300, 1e-12)
    before = alive()
    for _ in range(3):
        optimizer.minimize(Together(), np.full(3, -1.0), np.full(3, 2.0), np.random.default_rng(0))
    assert alive() == before


def alive() -> int:
    """How many searches are held by something."""
    gc.collect()
    return sum(type(kept) is Evaluations for kept in gc.get_objects())  # isinstance asks dead proxies too
