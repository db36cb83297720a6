from __future__ import annotations

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS

import simbias
from simbias.records import Iteration, Optimum
from simbias.study import Study

BALANCING = np.array([8.118, 4.783, -6.658, -0.366, -5.560])


@pytest.fixture(scope="module")
def short() -> Study:
    return simbias.load(["task.horizon=2000", "tracking=none"])


@pytest.fixture(scope="module")
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
                optimum=Optimum(theta, 3.0, 1000, "the test"),
                predicted_cost=short.simulate(theta, bias).cost,
                model_reset=False,
                experiments=experiments,
                hardware_cost=hardware_cost,
                succeeded=hardware_cost < short.cost.max_cost,
                total_experiments=2 * (index + 1),
                selection=selection,
                data=data,
                fitted_bias=bias,
            )
        )
    assert [iteration.succeeded for iteration in iterations] == [False, True]
    assert len(iterations[0].data) > 0
    return iterations


@pytest.fixture(scope="module")
def of_point_mass() -> tuple[Study, list[Iteration]]:
    study = simbias.load([*POINT_MASS, "tracking=none", "optimizer.max_evaluations=150"], OWN_CONF)
    return study, list(study.run())
