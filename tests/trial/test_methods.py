"""What `python -m simbias check` finds wrong with a method."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from point_mass import InTheWind

from simbias.core import Policy
from simbias.core.records import Array, Iteration, Rollout
from simbias.testing.conformance import verdicts
from simbias.trial.steps import experiment
from simbias.trial.study import Method, Observer, Study


class Guessing(Method):
    """Two iterations of two experiments, with policies by chance."""

    max_iterations = 2
    max_experiments = 4
    counts_from = 0
    shares_its_generator = False
    breaks = False

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        for index in range(2):
            if self.shares_its_generator:
                theta = 0.1 * rng.standard_normal(study.policy.n_parameters)
                made = tuple(study.experiment(theta, rng) for _ in range(2))
                for each in made:
                    observer.experimented(each)
            else:
                theta_rng, experiment_rng = rng.spawn(2)
                theta = 0.1 * theta_rng.standard_normal(study.policy.n_parameters)
                made = experiment(study, theta, experiment_rng, observer, 2)
            if self.breaks:
                raise ZeroDivisionError("of nothing")
            cost = max(rollout.cost for rollout in made)
            yield Iteration(index, theta, made, cost, False, self.counts_from + 2 * (index + 1))


class Gusty(InTheWind):
    """Draws from its generator, which an experiment that is recalled does not."""

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        rng.standard_normal()
        return super().run(policy, theta, start, rng)


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ({}, ""),
        ({"counts_from": 1}, "Guessing.run: expected 2 experiments so far, got 3"),
        ({"max_experiments": 3}, "Guessing.run: expected at most 3 experiments, got 4"),
        (
            {"shares_its_generator": True},
            "Guessing.run: expected each search and each experiment to have a generator of its own, got ",
        ),
        ({"breaks": True}, "ZeroDivisionError: of nothing"),
    ],
    ids=["nothing", "its count", "too many experiments", "one generator for all", "an exception"],
)
def test_what_is_wrong_is_one_line(point_mass: Study, wrong: dict[str, object], problem: str) -> None:
    method = Guessing()
    vars(method).update(wrong)
    study = replace(point_mass, method=method, hardware=Gusty(point_mass.task))  # type: ignore[arg-type]
    (verdict,) = verdicts(study, ["method"])
    assert problem in verdict.problem
    assert bool(problem) == bool(verdict.problem)
    assert "\n" not in verdict.problem
