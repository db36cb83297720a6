"""Checks of optimizer and method."""

from __future__ import annotations

import tempfile
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np

from simbias.core import Hardware, Optimizer, Policy
from simbias.core.errors import ConfigError
from simbias.core.records import Array, Iteration, Rollout
from simbias.lab.checked_hardware import DEFAULT_CONDITIONS
from simbias.simulation.closed_loop import simulator
from simbias.testing.expectations import ConformanceError, check, equal, expect
from simbias.trial.observer import Observer
from simbias.trial.policy_test import NO_TEST
from simbias.trial.run import run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome

EVALUATIONS, EXPERIMENTS = 30, 4  # per search, and per trial
MANY, NEAR = 200, 0.2  # evaluations from which a search comes so near to the minimum
ERRORS = 1000  # raised by an objective before its search is stopped
MINIMUM = 0.3  # in each coordinate of the box from -1 to 1


def _searched(optimizer: Optimizer) -> tuple[Array, Array]:
    """The points (k, 2) of a search for a known minimum with its whole budget, and the best one (2,)."""
    points: list[Array] = []

    def bowl(theta: Array) -> float:
        points.append(theta)
        return float(np.sum((theta - MINIMUM) ** 2))

    never = -1.0  # a cost that is not reached
    found = optimizer.minimize(bowl, -np.ones(2), np.ones(2), np.random.default_rng(5), never)
    return np.reshape(points, (-1, 2)), found.parameters


@check("optimizer", "a known minimum in the box, within the evaluations, by the same points each time")
def _optimizer_minimizes(study: Study) -> None:
    optimizer = copy(study.optimizer)
    if optimizer.max_seconds is not None:
        optimizer.max_seconds = None  # with a limit, the points depend on the machine
    (points, best), (same, _) = _searched(optimizer), _searched(optimizer)
    most, off = optimizer.max_evaluations, np.linalg.norm(best - MINIMUM)
    expect(len(points) <= most, "minimize", f"at most {most} evaluations", len(points))
    expect((np.abs(points) <= 1).all(), "minimize", "points in the box", np.abs(points).max(initial=0.0))
    expected = "the same points from the same generator"
    expect(len(same) == len(points), "search", expected, f"{len(same)} instead of {len(points)}")
    differ = (points != same).any(axis=1)
    expect(not differ.any(), "search", expected, f"others from evaluation {np.argmax(differ) + 1} on")
    if most >= MANY:
        expect(off < NEAR, "search", f"a point within {NEAR:g} of the minimum in {most} evaluations", off)


class _Stop(BaseException):
    """Ends a search that catches the objective's errors."""


@check("optimizer", "errors of the objective come through")
def _optimizer_raises(study: Study) -> None:
    raised = 0

    def broken(theta: Array) -> float:
        nonlocal raised
        raised += 1
        raise ZeroDivisionError if raised <= ERRORS else _Stop

    try:
        study.optimizer.minimize(broken, -np.ones(2), np.ones(2), np.random.default_rng(5))
    except (ZeroDivisionError, _Stop):
        if raised == 1:
            return
    raise ConformanceError("search: expected the objective's exception to end it, got a search that goes on")


class _NominalHardware(Hardware):
    """The nominal model instead of the hardware, which checks of other groups must not use."""

    def __init__(self, study: Study) -> None:
        self._study = study.without_targets
        self._cost = None if study.task.targets else study.cost  # so that nothing new is compiled

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """An experiment without noise."""
        rng.standard_normal()  # as noise would; a replayed experiment draws nothing
        model = replace(self._study, policy=policy).model()
        return simulator(model, cost=self._cost).rollout(theta, start)


def _on_nominal_model(study: Study) -> Study:
    """The study with short searches, and the nominal model as hardware; no confirmation, no policy test."""
    optimizer, budget, hardware = copy(study.optimizer), study.budget, _NominalHardware(study)
    optimizer.max_evaluations = min(EVALUATIONS, optimizer.max_evaluations)
    experiments = min(EXPERIMENTS, budget.experiments or EXPERIMENTS)
    method = copy(study.method)  # it may have its own hardware to search on
    vars(method).update((name, hardware) for name, own in vars(method).items() if isinstance(own, Hardware))
    return replace(
        study,
        hardware=hardware,
        hardware_of=lambda task: hardware,
        conditions=DEFAULT_CONDITIONS,
        policy_test=NO_TEST,
        optimizer=optimizer,
        method=method,
        budget=replace(budget, experiments=experiments),
    )


@check("method", "experiments are counted, limited, replayed and repeated by seed (on the nominal model)")
def _method_counts_and_replays(study: Study) -> None:
    study = _on_nominal_model(study)
    made: list[Rollout] = []
    counts: list[int] = []  # after each iteration

    class Count(Observer):
        def experimented(self, rollout: Rollout) -> None:
            made.append(rollout)

        def iterated(self, iteration: Iteration) -> None:
            counts.append(len(made))

    expected = "each search and each experiment to have a generator of its own"
    with tempfile.TemporaryDirectory() as folder:
        first = run_trial(study, Path(folder, study.hash), Count())
        if first.outcome in (Outcome.ERROR, Outcome.WAITING):
            list(study.run())  # raises errors that a record only reports
        try:
            again = run_trial(study, Path(folder, study.hash))
        except ConfigError as error:
            raise ConformanceError(f"method.run: expected {expected}, got others when begun again") from error
        anew = run_trial(study, Path(folder, "anew"))
    for iteration, count in zip(first.iterations, counts, strict=True):
        total = iteration.total_experiments
        expect(total == count, "method.run", f"{count} experiments so far", total)
    most = study.max_experiments
    expect(len(made) <= most, "method.run", f"at most {most} experiments", len(made))
    for trial, same in ((again, expected), (anew, "the same trial from the same seed")):
        kept = f"{len(trial.iterations)} of {len(first.iterations)} iterations when begun again"
        expect(len(trial.iterations) == len(first.iterations), "method.run", same, kept)
        for one, other in zip(trial.iterations, first.iterations, strict=True):
            equal(one.parameters, other.parameters, "method.run", same, 0.0)
            equal(one.hardware_cost, other.hardware_cost, "method.run", same, 0.0)
