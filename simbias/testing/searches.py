"""Checks of what searches: optimizer and method."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from simbias.records import Array, Rollout
from simbias.study import Observer, Study
from simbias.testing.check import check
from simbias.testing.expectations import (
    ConformanceError,
    equal,
    expect,
)
from simbias.tracking.journal import Journal
from simbias.trial import run_trial


@check("optimizer", "a known minimum in the box, within the evaluations, the same each time")
def _optimizer_minimizes(study: Study) -> None:
    points: list[Array] = []

    def bowl(theta: Array) -> float:
        points.append(theta)
        return float(np.sum((theta - 0.3) ** 2))

    def minimum() -> Array:
        points.clear()
        return study.optimizer.minimize(bowl, -np.ones(2), np.ones(2), np.random.default_rng(5)).parameters

    best = minimum()
    most = study.optimizer.max_evaluations
    expect(len(points) <= most, "minimize", f"at most {most} evaluations", len(points))
    expect((np.abs(points) <= 1).all(), "minimize", "points in the box", np.abs(points).max())
    expect(bowl(best) < bowl(np.zeros(2)), "minimize", "a better point than the centre", best)
    equal(minimum(), best, "minimize", "the same from the same generator", 0.0)


@check("optimizer", "what the objective raises comes through")
def _optimizer_raises(study: Study) -> None:
    def broken(theta: Array) -> float:
        raise ZeroDivisionError

    try:
        study.optimizer.minimize(broken, -np.ones(2), np.ones(2), np.random.default_rng(5))
    except ZeroDivisionError:
        return
    raise ConformanceError("minimize: expected the objective's exception, got none")


@check("method", "iterations that count their experiments, and no more than it may make")
def _method_counts(study: Study) -> None:
    made: list[Rollout] = []

    class Count(Observer):
        def experimented(self, rollout: Rollout) -> None:
            made.append(rollout)

    for iteration in study.run(Count()):
        total = iteration.total_experiments
        expect(total == len(made), "method.run", f"{len(made)} experiments so far", total)
    most = study.method.max_experiments
    expect(len(made) <= most, "method.run", f"at most {most} experiments", len(made))


@check("method", "a trial that is started again recalls what it did, and ends as it did")
def _method_replays(study: Study) -> None:
    with tempfile.TemporaryDirectory() as folder:
        first, again = (run_trial(study, Journal(Path(folder))) for _ in range(2))
    equal(len(again.iterations), len(first.iterations), "method.run", "as many iterations", 0.0)
    for one, other in zip(again.iterations, first.iterations, strict=True):
        expected = "each search and each experiment to have a generator of its own"
        equal(one.parameters, other.parameters, "method.run", expected, 0.0)
        equal(one.hardware_cost, other.hardware_cost, "method.run", expected, 0.0)
