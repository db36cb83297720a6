from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from in_numpy import simulate_in_numpy

import simbias
from simbias.core.records import Iteration, Learning, Optimum, Search
from simbias.trial.method import Method
from simbias.trial.observer import Observer
from simbias.trial.study import Study

BALANCING = np.array([8.118, 4.783, -6.658, -0.366, -5.560])


@pytest.fixture(scope="session")
def short() -> Study:
    return simbias.load(["task.horizon=1000"])


@pytest.fixture(scope="session")
def trial(short: Study) -> list[Iteration]:
    """A policy that falls on hardware, and one that balances there; a bias was learned in between."""
    data, iterations = short.no_data, []
    for index, theta in enumerate((np.zeros(5), BALANCING)):
        rngs = np.random.default_rng(2 * index).spawn(2)
        experiments = tuple(short.experiment(theta, rng) for rng in rngs)
        bias, selection = short.bias.fit(data), short.samples.select(experiments, short.nominal)
        hardware_cost = max(rollout.cost for rollout in experiments)
        data = data | selection.transitions
        iterations.append(
            Iteration(
                index=index,
                parameters=theta,
                experiments=experiments,
                hardware_cost=hardware_cost,
                succeeded=all(map(short.cost.passes, experiments)),
                total_experiments=2 * (index + 1),
                model=short.model(bias),
                search=Search(Optimum(theta, 3.0, 1000, "the test"), short.simulate(theta, bias).cost),
                learning=Learning(selection, data),
            )
        )
    assert [iteration.succeeded for iteration in iterations] == [False, True]
    assert len(iterations[0].learning.data) > 0
    return iterations


@pytest.fixture
def of_point_mass(
    uncompiled: None, trial_of_point_mass: tuple[Study, list[Iteration]]
) -> tuple[Study, list[Iteration]]:
    """A trial of one's own components, simulated in NumPy."""
    return trial_of_point_mass


@pytest.fixture(scope="session")
def trial_of_point_mass() -> tuple[Study, list[Iteration]]:
    study = simbias.load([*POINT_MASS, "optimizer.max_evaluations=50"], OWN_CONF)
    with pytest.MonkeyPatch.context() as patch:
        simulate_in_numpy(patch)  # for a session
        return study, list(study.run())


class Tries(Method):
    """Tries two policies on the hardware in each iteration, without search, simulation or learning."""

    max_iterations, max_experiments = 2, 4

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        for index, thetas in enumerate(([np.zeros(5), BALANCING], [BALANCING + 0.1, BALANCING])):
            rngs = np.random.default_rng(index).spawn(len(thetas))
            experiments = tuple(study.experiment(*pair) for pair in zip(thetas, rngs, strict=True))
            best = min(experiments, key=lambda rollout: rollout.cost)
            yield Iteration(
                index=index,
                parameters=best.parameters,
                experiments=experiments,
                hardware_cost=best.cost,
                succeeded=study.cost.passes(best),
                total_experiments=2 * (index + 1),
            )


@pytest.fixture(scope="session")
def on_hardware(short: Study) -> list[Iteration]:
    """A trial of a method without search and learning: several policies, and that which did best."""
    return list(replace(short, method=Tries()).run())
