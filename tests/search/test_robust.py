"""The predicted cost under noise, from several starts, on sampled models."""

from collections.abc import Sequence

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from hypothesis import given, settings
from hypothesis import strategies as st

import simbias
from simbias.core import Cost
from simbias.core.records import Array, Indices, Rollout
from simbias.search.evaluation.robust import Robust
from simbias.search.evaluation.scenarios import CostOfScenarios, Scenario
from simbias.simulation.numpy_loop import costs_of
from simbias.trial.observer import Observer
from simbias.trial.steps import search
from simbias.trial.study import Study

NOISE = {"torque_variance": 0.1, "angle_variance": 1e-6, "velocity_variance": 1e-3}
MAX_COST = 100.0
NOMINAL = ["evaluation.rollouts=1", *(f"evaluation.sample_{each}=false" for each in ("starts", "nominal"))]


def objective(study: Study, seed: int = 0, **options: object) -> CostOfScenarios:
    evaluation = Robust(study.task, noise=NOISE, **options)  # type: ignore[arg-type]
    made = evaluation.objective(study.model(), study.cost, np.random.default_rng(seed))
    assert isinstance(made, CostOfScenarios)
    return made


class FakeSimulator:
    """Gives out rollouts whose costs are known, and remembers who asked."""

    def __init__(self, costs: Sequence[float]) -> None:
        self.known = dict(enumerate(costs))
        self.asked: list[int] = []

    def rollout(self, theta: Array, start: Array) -> Rollout:
        self.asked.append(int(theta[0]))
        return Rollout(np.zeros((1, 1)), np.zeros((0, 1)), cost=self.known[int(theta[0])])

    def rollouts(self, thetas: Array, starts: Array) -> list[Rollout]:
        return [self.rollout(theta, start) for theta, start in zip(thetas, starts, strict=True)]

    def costs(self, cost: Cost, thetas: Array, starts: Array) -> tuple[Array, Indices]:
        return costs_of(cost, self.rollouts(thetas, starts))


class RolloutsOwn:
    """A cost that was known before."""

    max_cost = MAX_COST

    def of(self, rollout: Rollout) -> float:
        return rollout.cost


@settings(max_examples=25, deadline=None)
@given(
    st.integers(1, 6).flatmap(
        lambda k: st.lists(st.lists(st.floats(0.0, 200.0), min_size=k, max_size=k), min_size=1, max_size=6)
    ),
    st.integers(1, 6),
    st.integers(1, 6),
)
def test_aggregate_and_screening(table: list[list[float]], worst: int, screening: int) -> None:
    """Rows are policies. Hopeless ones, failed in all screening rollouts, are asked for no further."""
    simulators = [FakeSimulator(column) for column in zip(*table, strict=True)]
    scenarios = [Scenario(simulator, np.zeros(1)) for simulator in simulators]
    thetas = np.arange(len(table), dtype=float)[:, None]
    costs = CostOfScenarios(scenarios, RolloutsOwn(), worst, screening).together(thetas)  # type: ignore[arg-type]
    for policy, row in enumerate(table):
        hopeless = len(row) >= screening and min(row[:screening]) > MAX_COST
        seen = row[:screening] if hopeless else row
        assert [policy in simulator.asked for simulator in simulators] == [
            index < len(seen) for index in range(len(row))
        ]
        assert costs[policy] == pytest.approx(np.mean(sorted(seen)[-worst:]))


def test_the_declared_noise_is_the_hardwares() -> None:
    """By default; that of a hardware without any is none."""
    noisy = ["tracking=none", "evaluation=robust", "hardware.noise.torque_variance=0.1", "task.horizon=50"]
    study = simbias.load(noisy)
    scenarios = study.evaluation.objective(study.model(), study.cost, np.random.default_rng(0)).scenarios
    noise = np.concatenate([scenario.simulator.noise for scenario in scenarios])
    assert np.var(noise[:, :-1, 0]) == pytest.approx(0.1, rel=0.3)
    assert not noise[..., 1:].any()
    study = simbias.load([*POINT_MASS, "tracking=none", "evaluation=domain_randomization"], OWN_CONF)
    costs = study.evaluation.objective(study.model(), study.cost, np.random.default_rng(0))
    assert [scenario.simulator.noise.shape for scenario in costs.scenarios] == [(1, 0, 3)] * 8
    assert np.isfinite(costs(np.array([9.0, 4.0, 0.0])))


def test_the_worst_are_the_smallest_number_that_is_their_share(study: Study) -> None:
    """Of 100 costs 0.07 are 7, although 0.07 * 100 is more by rounding."""
    for tail, rollouts, worst in ((0.07, 100, 7), (0.25, 8, 2), (0.26, 8, 3), (1e-12, 8, 1)):
        assert Robust(study.task, rollouts=rollouts, aggregate="cvar", tail=tail)._worst == worst


def test_options_change_only_what_they_name(study: Study) -> None:
    plain = objective(study, rollouts=3).scenarios
    drawn = objective(study, rollouts=3, sample_nominal=True).scenarios
    fixed = objective(study, rollouts=3, sample_starts=False).scenarios
    for a, b, c in zip(plain, drawn, fixed, strict=True):
        np.testing.assert_array_equal(a.start, b.start)
        np.testing.assert_array_equal(c.start, study.task.start_mean)
        for other in (b, c):
            np.testing.assert_array_equal(a.simulator.noise, other.simulator.noise)
    assert len({scenario.start.tobytes() for scenario in plain}) == 3


def test_without_noise_and_sampling_it_is_the_papers(study: Study) -> None:
    """One quiet rollout from the mean start is what `nominal_start` predicts."""
    evaluation = Robust(study.task, rollouts=1, sample_starts=False)
    rng = np.random.default_rng(0)
    theta = np.array([1.0, 1.0, -2.0, -1.0, 2.0])
    quiet = evaluation.objective(study.model(), study.cost, rng)
    assert quiet(theta) == study.evaluation.objective(study.model(), study.cost, rng)(theta)


def test_a_drawn_model_has_masses_as_uncertain_as_declared() -> None:
    def drawn(deviation: float, count: int) -> list[Array]:
        sure = f"nominal.uncertainty={{masses: {deviation}, foot_mass: 0}}"
        nominal, rng = simbias.load(["tracking=none", sure]).nominal, np.random.default_rng(0)
        return [nominal.kernel.parameters, *(nominal.draw(rng).kernel.parameters for _ in range(count))]

    _, *models = drawn(0.1, 1000)
    c9, robot = np.array(models)[:, -1], simbias.load(["tracking=none"]).task.robot
    share = np.array([robot.leg_mass, robot.pelvis_mass]) / (robot.leg_mass + robot.pelvis_mass)
    deviation = 0.1 * np.linalg.norm(share)  # c9 = g l (m_l + m_p), to first order in the deviations
    assert np.std(c9) / np.mean(c9) == pytest.approx(deviation, rel=0.1)
    np.testing.assert_array_equal(*drawn(0.0, 1))


@pytest.mark.slow
def test_rollouts_may_take_longer_than_experiments(study: Study, uncompiled: None) -> None:
    """Costs are those of rollouts of so many seconds; the experiments stay as long as they are."""
    made = objective(study, rollouts=3, seconds=0.05)
    cost = study.cost.with_horizon(50)
    for theta in np.random.default_rng(3).uniform(-3, 3, (2, 5)):
        rollouts = [scenario.simulator.rollout(theta, scenario.start) for scenario in made.scenarios]
        assert {rollout.frames for rollout in rollouts} == {50}
        assert made(theta) == pytest.approx(np.mean([cost.of(rollout) for rollout in rollouts]), rel=1e-9)
    assert study.task.horizon == 5000


def test_fresh_scenarios_repeat_by_seed_and_differ_by_call(study: Study) -> None:
    """They leave the common ones alone, by which the means of generations are judged."""
    thetas = np.random.default_rng(1).uniform(-3, 3, (4, 5))
    first, second = (objective(study, rollouts=3, sample_nominal=True, fresh=True) for _ in range(2))
    common = objective(study, rollouts=3, sample_nominal=True)
    ranked = [first.rank(thetas) for _ in range(3)]
    np.testing.assert_array_equal(ranked, [second.rank(thetas) for _ in range(3)])
    assert len({costs.tobytes() for costs in ranked}) == 3
    np.testing.assert_array_equal(first.together(thetas), common.together(thetas))
    np.testing.assert_array_equal(common.rank(thetas), common.together(thetas))
    assert first.steps > common.steps > 0


def test_a_first_stage_is_the_papers_prediction_and_changes_no_scenario(study: Study) -> None:
    theta = np.array([1.0, 1.0, -2.0, -1.0, 2.0])
    staged, alone = (objective(study, rollouts=3, from_nominal=each) for each in (True, False))
    papers = study.evaluation.objective(study.model(), study.cost, np.random.default_rng(0))
    assert staged.first_stage(theta) == papers(theta)
    assert alone.first_stage is None
    assert staged(theta) == alone(theta)


@pytest.mark.slow
def test_a_search_in_fresh_scenarios_holds_on_models_that_it_has_not_met() -> None:
    """Those of the nominal model from its mean start let the cart-pole fall on more that might be right."""
    options = ["preset=cartpole", "optimizer=cma", "tracking=none", "optimizer.max_evaluations=400"]
    options += ["nominal.uncertainty={cart_mass: 0.5, pole_mass: 0.5, length: 0.5}"]
    options += ["evaluation=fresh_randomization"]
    tester = simbias.load([*options, "evaluation.rollouts=30"])
    unmet = tester.evaluation.objective(tester.first_model(), tester.cost, np.random.default_rng(5))
    held = {}
    for name, scenarios in (("nominal", NOMINAL), ("fresh", [])):
        study, lasted = simbias.load([*options, *scenarios]), []
        for seed in range(2):
            made = search(study, study.first_model(), np.random.default_rng(seed), Observer())
            asked = made.optimum.parameters[None]
            for each in unmet.scenarios:
                _, frames = each.simulator.costs(study.cost, asked, each.start[None])
                lasted += list(frames == study.task.horizon)
        held[name] = np.mean(lasted)
    assert held["fresh"] > max(0.9, held["nominal"])
