"""Every rival on a case where it must work: the point mass in a wind, or a cost that is known."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from hardware import counted
from point_mass import InTheWind, WithoutWind

import simbias
from simbias.core import Waiting
from simbias.core.errors import ConfigError
from simbias.core.records import Array
from simbias.lab.checked_hardware import ExperimentConditions
from simbias.lab.requests.process import Process
from simbias.lab.safety import Safety
from simbias.learning.bias.gp import GaussianProcess
from simbias.search.evaluation.robust import Robust
from simbias.testing.conformance import verdicts
from simbias.trial.folder import OUTCOME, TrialFolder
from simbias.trial.hardware_cost import cost_on_hardware
from simbias.trial.method import Method
from simbias.trial.methods.cost_residual import CostResidual
from simbias.trial.methods.direct_search import PROPOSALS, DirectSearch
from simbias.trial.methods.ideal import Ideal
from simbias.trial.methods.inaccurate_model import InaccurateModel, along, gradient
from simbias.trial.methods.multi_fidelity import MultiFidelity
from simbias.trial.methods.one_shot import OneShot
from simbias.trial.run import run_trial
from simbias.trial.steps import log_costs
from simbias.trial.study import Study
from simbias.trial.summary import Outcome


def wind(point_mass: Study):
    """What a `middle` is constructed by: a hardware from its config."""
    return lambda config: InTheWind(point_mass.task, **config)


@pytest.fixture
def searching() -> Study:
    """The point mass, few of whose policies are tried in a simulator that takes one after the other."""
    return simbias.load([*POINT_MASS, "tracking=none", "optimizer.max_evaluations=50"], OWN_CONF)


METHODS: dict[str, Method] = {
    "ideal": Ideal(rollouts=2),
    "one_shot": OneShot(batch=3),
    "cost_residual": CostResidual(max_iterations=2),
    "inaccurate_model": InaccurateModel(max_iterations=2),
    "cma": DirectSearch("cma", max_iterations=2),
    "bayesian": DirectSearch("bayesian", max_iterations=5),
    "multi_fidelity": MultiFidelity(lambda config: None, max_iterations=2),  # type: ignore[arg-type,return-value]
}


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_each_keeps_the_contract_and_is_resumed(hasty: Study) -> None:
    """Counted experiments, no more than it may make, replayed when a trial is started again."""
    for name, method in METHODS.items():
        for verdict in verdicts(replace(hasty, method=method), ["method"]):
            assert not verdict.problem, name


@pytest.mark.slow
def test_ideal_holds_what_the_model_does_not(searching: Study) -> None:
    """Its policy is searched in the wind, and no experiment is spent on that."""
    record = run_trial(replace(searching, method=Ideal(rollouts=2)))
    assert (record.outcome, record.summary.experiments) == (Outcome.SUCCEEDED, 2)
    assert record.iterations[0].parameters[2] == pytest.approx(-2.0, abs=0.7)  # the wind, balanced


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_a_search_on_hardware_moves_no_robot_unasked(hasty: Study) -> None:
    """Nor one that is asked for by `study.ask()`, or held by limits, which the search keeps."""
    ideal = replace(hasty, method=Ideal(rollouts=1))
    real = replace(ideal, hardware=Process(hasty.task, "true"))
    with pytest.raises(ConfigError, match=r"^method: searches on the hardware itself, but Process is not a"):
        run_trial(real)
    middle = MultiFidelity(lambda config: real.hardware, {"command": "true"})
    with pytest.raises(ConfigError, match=r"^method\.middle: searches .*, but Process is not a simulator"):
        run_trial(replace(hasty, method=middle))
    own, log = counted(hasty)
    middle = MultiFidelity(lambda config: own.hardware, {})
    refusing = ExperimentConditions(confirm=True, ask=lambda *_: False)
    behind = simbias.load(["preset=double_cartpole", "tracking=none"])
    assert behind.hardware.simulates
    behind.hardware.simulates = False  # as of an environment of one's own
    asked = replace(behind, conditions=refusing)
    with pytest.raises(Waiting):
        cost_on_hardware(asked, asked.hardware, np.random.default_rng(0), 1)(np.zeros(6))
    for method in (ideal.method, middle):
        study = replace(own, method=method)
        with pytest.raises(ConfigError, match=r"^method: searches on hardware, which study.ask\(\)"):
            study.ask()
        assert run_trial(replace(study, conditions=refusing)).outcome is Outcome.WAITING
        assert not log
    limited = ExperimentConditions(safety=Safety(states={"position": 0.1}))
    held = replace(hasty, conditions=limited)
    cost = cost_on_hardware(held, held.hardware, np.random.default_rng(0), 1)
    assert cost(np.zeros(3)) > hasty.cost.max_cost + 9  # it fails where it starts


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_one_shot_learns_once(point_mass: Study) -> None:
    record = run_trial(replace(point_mass, method=OneShot(batch=3, experiments=2)))
    first, second = record.iterations
    assert (len(first.experiments), len(second.experiments)) == (3, 2)
    assert first.model.bias.predict(np.zeros((1, 3)))[0].max() == 0
    assert second.model.bias.predict(first.learning.data.inputs)[0][:, 1].mean() > 0.02  # the wind
    assert record.outcome is Outcome.SUCCEEDED


@pytest.mark.slow
def test_a_residual_on_the_cost_leaves_policies_that_are_refuted(point_mass: Study) -> None:
    """The model predicts the same for all constant forces; experiments tell which balances the wind."""
    record = run_trial(replace(point_mass, method=CostResidual(max_iterations=10, length_scale=0.3)))
    costs = [iteration.hardware_cost for iteration in record.iterations]
    assert len({tuple(iteration.parameters) for iteration in record.iterations}) == len(costs) > 1
    assert min(costs) < 0.8 * costs[0]


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_a_residual_on_the_cost_is_resumed_in_the_same_fresh_scenarios(
    point_mass: Study, tmp_path: Path
) -> None:
    optimizer = simbias.load(["optimizer=cma", "optimizer.max_evaluations=40", "tracking=none"]).optimizer
    fresh = Robust(point_mass.task, 2, {"force_variance": 4.0}, fresh=True)
    method = CostResidual(max_iterations=2)
    study = replace(point_mass, method=method, evaluation=fresh, optimizer=optimizer)
    whole = run_trial(study, tmp_path)
    first, *others = (i for i, file in enumerate(TrialFolder(tmp_path).steps()) if "iteration" in file.name)
    assert others
    for file in (*TrialFolder(tmp_path).steps()[first + 1 :], tmp_path / OUTCOME):
        file.unlink()
    for one, other in zip(run_trial(study, tmp_path).iterations, whole.iterations, strict=True):
        np.testing.assert_array_equal(one.parameters, other.parameters)


def test_the_model_is_exact_along_an_experiment(point_mass: Study) -> None:
    """So its gradient is the hardware's, which the model itself has not."""
    theta = np.array([3.0, 3.0, 0.0])
    rollout = point_mass.experiment(theta, np.random.default_rng(0))
    model = point_mass.first_model()
    heavy = replace(model, nominal=WithoutWind(point_mass.task, 2.0))  # as recordings identify it
    lightly, heavily = (along(each, np.stack([theta, 0 * theta]), rollout) for each in (model, heavy))
    for same in (lightly[0], heavily[0]):
        np.testing.assert_allclose(same.states, rollout.states, atol=1e-12)
    assert np.abs(lightly[1].states - heavily[1].states[: lightly[1].frames + 1]).max() > 0.01
    direction = gradient(point_mass, model, theta, rollout)
    hardware = InTheWind(point_mass.task)

    def cost(offset: Array) -> float:
        run = hardware.run(point_mass.policy, theta + offset, rollout.states[0], np.random.default_rng(0))
        return point_mass.cost.of(run)

    width = np.subtract(*point_mass.policy.bounds[::-1])
    slopes = np.array(
        [cost(1e-3 * w * e) - cost(-1e-3 * w * e) for w, e in zip(width, np.eye(3), strict=True)]
    )
    np.testing.assert_allclose(direction, slopes / np.linalg.norm(slopes), atol=0.02)
    free = replace(rollout, states=0 * rollout.states)
    with pytest.raises(ConfigError, match=r"^cost: is 0; this method needs positive costs"):
        log_costs(point_mass.cost.of(free))
    record = run_trial(replace(point_mass, method=InaccurateModel(step=0.05, max_iterations=6)))
    costs = [iteration.hardware_cost for iteration in record.iterations]
    assert min(costs) < 0.8 * costs[0]  # steps along the gradient cost less


@pytest.mark.slow
def test_simulators_of_rising_fidelity_end_at_the_top(searching: Study) -> None:
    """The one in the middle knows most of the wind: its policy, not the model's, is the first on hardware."""
    method = MultiFidelity(wind(searching), {"wind": 1.8}, rollouts=2, max_iterations=3)
    record = run_trial(replace(searching, method=method))
    (only,) = record.iterations
    assert only.succeeded
    assert len(only.experiments) == 2  # of the hardware
    assert only.parameters[2] == pytest.approx(-1.8, abs=0.7)
    np.testing.assert_array_equal(only.search.optimum.parameters, only.parameters)
    assert only.search.predicted_cost == only.search.optimum.cost  # of this policy, in the middle


@pytest.mark.slow
def test_what_the_top_says_corrects_the_bottom(searching: Study) -> None:
    study = replace(searching, bias=GaussianProcess(searching.task))
    method = MultiFidelity(wind(searching), {"wind": -2.0}, rollouts=2, max_iterations=3)
    record = run_trial(replace(study, method=method))
    assert not record.iterations[0].succeeded
    assert record.outcome is Outcome.SUCCEEDED


@pytest.mark.slow
def test_a_direct_search_finds_a_known_minimum() -> None:
    lower, upper, best = -np.ones(2), np.ones(2), np.array([0.3, -0.2])
    for strategy, proposed in PROPOSALS.items():
        proposals = proposed(lower, upper, np.zeros(2), 0.25, np.random.default_rng(0))
        theta, costs = next(proposals), []
        for _ in range(12 if strategy == "bayesian" else 40):  # each of its proposals takes longer
            assert (np.abs(theta) <= 1).all()
            costs.append(0.01 + float(np.sum((theta - best) ** 2)))
            theta = proposals.send(costs[-1])
        assert min(costs) < 0.03 < costs[0], strategy


@pytest.mark.slow  # imports the library
def test_bayesian_optimisation_tries_the_suggested_policies(monkeypatch: pytest.MonkeyPatch) -> None:
    suggestions = ({f"p{i:03}": 0.1 * k + i for i in range(2)} for k in itertools.count())
    monkeypatch.setattr("bayes_opt.BayesianOptimization.suggest", lambda search: next(suggestions))
    proposals = PROPOSALS["bayesian"](-np.ones(2), np.ones(2), np.zeros(2), 0.25, np.random.default_rng(0))
    tried = [next(proposals), *(proposals.send(1.0) for _ in range(5))]
    np.testing.assert_allclose(tried[-2:], [[0.0, 1.0], [0.1, 1.1]])


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_a_direct_search_may_begin_at_lqr(tmp_path: Path) -> None:
    study = simbias.load(["preset=cartpole", "method=direct_search_lqr", "tracking=none"])
    record = run_trial(study, tmp_path / "trial")
    assert record.outcome is Outcome.SUCCEEDED
    assert record.iterations[0].parameters == pytest.approx(
        run_trial(replace(study, method=simbias.load(["method=lqr", "tracking=none"]).method))
        .iterations[0]
        .parameters
    )


def test_a_middle_is_an_option_of_the_group_hardware() -> None:
    middle = "+hardware@method.middle=mujoco_bongoboard"
    study = simbias.load(["method=multi_fidelity", middle, "tracking=none"])
    assert type(study.method._middle).__name__ == "MujocoBongoboard"  # type: ignore[attr-defined]
    assert type(study.hardware).__name__ == "PymunkBongoboard"
