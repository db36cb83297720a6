"""Oddities of a running trial, each reported at once in a line, before more hardware is spent."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from simbias.core import Cost, Model, Nominal
from simbias.core.messages import counted
from simbias.core.records import Array, Iteration, Rollout, Search, Selection
from simbias.lab.safety import exceeded
from simbias.learning.identification.directions import undetermined
from simbias.learning.identification.identified import Identified
from simbias.policy.trajectory import Trajectory
from simbias.search.optimizer.ilqr import SHARE
from simbias.simulation.closed_loop import simulator
from simbias.simulation.goal import goal_along, goal_held, moves
from simbias.trial.claim import iterations_with
from simbias.trial.study import Study

NEARER, EARLIER = 0.95, 0.9  # of the least shortfall in the first 90%: a last one below is still falling
ROUGH = 0.5  # of the residuals' root mean square: larger errors of a sparse posterior are reported
STARTS = 20  # simulated for a policy if the task does not define success
CHATTER = 0.1  # of an input's range: a larger mean change from frame to frame is reported
DEFAULT_WEIGHTS = "; the plan has default weights, as this cost gives none: set them with cost=tracking"

_simulated: WeakKeyDictionary[Iteration, tuple[Remark, ...]] = WeakKeyDictionary()


class Remark(NamedTuple):
    """Something odd about a trial."""

    kind: str  # in few words, the same at every occurrence
    words: str  # in one line, with its numbers


def of_experiments(experiments: Sequence[Rollout], study: Study) -> list[str]:
    """How many hardware experiments fail, miss the goal or cost too much, and why, in words."""
    task, ends = study.task, defaultdict[str, list[str]](list)
    for each in experiments:
        if each.failed_at is not None:
            ends["failed"].append(task.words(each.failure or "failed"))
        elif not study.passes(each) and task.says_success:
            ends["missed the goal"].append(task.missed(each.states))
        elif not study.passes(each):
            ends[f"cost too much (Z_max {study.cost.max_cost:g})"].append(f"{each.cost:.4g}")
    of = counted(len(experiments), "experiment")
    return [f"{len(each)} of {of} {end}: {', '.join(dict.fromkeys(each))}" for end, each in ends.items()]


def of_policy(
    theta: Array, model: Model | None, search: Search | None, earlier: Sequence[Iteration]
) -> Iterator[Remark]:
    """Oddities of a policy theta (p,), searched or not, that was made on a model after earlier iterations."""
    policy = None if model is None else model.policy
    planned = isinstance(policy, Trajectory) and not policy.searched_knots  # only gains differ
    if search is not None and search.optimum.flat and not planned:
        optimum = search.optimum
        yield Remark(
            "all simulated policies cost the same",
            f"all {optimum.evaluations} simulated policies cost the same ({optimum.cost:g}), so this one is "
            "arbitrary; does every simulation fail immediately, or start at rest, where none of them acts?",
        )
    if same := iterations_with(theta, model, earlier):
        yield Remark(
            "a refuted policy was tried again",
            f"this is again the policy of iteration {same[0].index}, which did not succeed on the hardware; "
            "learning has not changed it since",
        )


def of_goal(rollout: Rollout, model: Model, planned: bool = False, weighed: bool = True) -> Iterator[Remark]:
    """Why a rollout simulated on a model does not succeed, if its task defines success.

    It may be `planned`, with the weights of its study's cost if that has such (`weighed`).
    """
    task = model.task
    if rollout.failure is not None:
        yield Remark(
            "a policy fails in simulation",
            f"this policy fails in simulation, after {rollout.frames * task.time_step:.2f} s: "
            f"{task.words(rollout.failure)}",
        )
        return
    if not task.goals or task.succeeds(rollout.states) is not False:
        return
    seconds, missed = rollout.frames * task.time_step, task.missed(rollout.states)
    yield Remark(
        "a policy does not reach the goal in simulation",
        f"this policy does not reach the goal in {seconds:g} s of simulation: {missed}; "
        f"{_at_limits(rollout.inputs, model, planned)}{_beyond_reach(rollout.states, model, planned)}"
        f"{DEFAULT_WEIGHTS * (planned and not weighed)}",
    )


def _at_limits(inputs: Array, model: Model, planned: bool) -> str:
    """In how many frames inputs (T, m) are at their limits, those of the planner for a plan, in words."""
    share = SHARE if planned else 1.0
    lower, upper = model.task.input_bounds
    lower, upper = np.maximum(lower, share * lower), np.minimum(upper, share * upper)
    slack = np.nan_to_num(0.01 * (upper - lower), posinf=0.0)  # an input may have no limit
    full = np.mean(((inputs <= lower + slack) | (inputs >= upper - slack)).any(axis=1))
    whose = "their limits" if share == 1.0 else f"the planner's limits ({share:.0%} of the task's)"
    return f"inputs are at {whose} in {full:.0%} of the frames"


def _beyond_reach(states: Array, model: Model, planned: bool) -> str:
    """Why states (T+1, n) miss the goal, and what may help, in words."""
    task = model.task
    if not goal_held(task, model.nominal):
        return ", and cannot hold the goal"
    short = task.shortfalls(states)
    coming = (short[-1] < NEARER * short[: int(EARLIER * len(short))].min(axis=0, initial=np.inf)).all()
    late = "; it was still approaching, so the horizon may be too short" if coming else ""
    random = planned and not moves(goal_along(task))
    if random and (short[-1] <= 0).all() and not getattr(model.policy, "resting", 0.0):
        return "; the plan is there at the end only: with policy.resting (s), it rests there before the end"
    return late + "; a larger method.trajectories tries more plans" * random


def of_starts(theta: Array, model: Model, cost: Cost) -> Iterator[Remark]:
    """A remark if a policy theta (p,) fails in simulation from most of the starts drawn by the task."""
    rng, failures = np.random.default_rng(0), list[str]()
    for _ in range(STARTS):
        rollout = _simulated_on(model, theta, model.task.draw_start(rng), cost)
        if rollout.failed_at is not None:
            failures.append(model.task.words(rollout.failure or "failed"))
    if len(failures) > STARTS / 2:
        yield Remark(
            "a policy fails in simulation",
            f"this policy fails in simulation, from {len(failures)} of {STARTS} starts that the task draws: "
            f"{', '.join(dict.fromkeys(failures))}",
        )


def of_safety(theta: Array, start: Array, model: Model | None, study: Study) -> Iterator[Remark]:
    """A remark if theta (p,) from a start (n,) exceeds the limits of `hardware.safety` in simulation."""
    task, safety = study.task, study.conditions.safety
    if model is None or not safety.limits:
        return
    if beyond := exceeded(_simulated_on(model, theta, start, study.cost), task, safety.bounds(task)):
        yield Remark(
            "a policy goes beyond hardware.safety in simulation",
            f"this policy goes beyond hardware.safety in simulation: {beyond}; experiments are "
            "aborted there, but searches ignore these limits",
        )


def of_model(theta: Array, model: Model, cost: Cost) -> Iterator[Remark]:
    """A remark if a policy theta (p,) relies on parameters that the data do not determine.

    It does if it lasts in simulation on the most probable model, but not on a model that is one posterior
    standard deviation away, in a direction along which the data hardly narrow the prior.
    """
    if not isinstance(nominal := model.nominal, Identified):
        return

    def fails(other: Nominal) -> bool:
        rollout = _simulated_on(replace(model, nominal=other), theta, model.task.start_mean, cost)
        return rollout.failed_at is not None

    directions = undetermined(nominal)
    if not directions or fails(nominal.model):
        return
    for direction in directions:
        aside = direction.deviation * direction.vector
        if any(fails(nominal.at(nominal.mode + side * aside)) for side in (-1.0, 1.0)):
            yield Remark(
                "a policy stands on what the data do not determine",
                f"this policy lasts in simulation, but fails on a model one standard deviation away along "
                f"{direction}, which the experiments do not determine",
            )
            return


def of_draws(rollout: Rollout, model: Model, study: Study) -> Iterator[Remark]:
    """A remark if a search adds the residual to drawn nominal models, for which it was not learned."""
    drawn = study.evaluation.draws_nominal and model.nominal.parameters
    if not drawn or isinstance(model.nominal, Identified):  # its draws surround the fitted model
        return
    x = rollout.states[:-1, : len(model.task.without_targets.states)]
    if model.bias.correction(x, rollout.inputs).any():
        yield Remark(
            "a residual is added to drawn models",
            "the search draws nominal models, but adds the residual of the undrawn one to each, so the "
            "difference counts twice; choose evaluation=robust or identification=posterior",
        )


def of_prediction(theta: Array, model: Model | None, study: Study) -> Iterator[Remark]:
    """Oddities of a policy theta (p,) on the model it was made on, before hardware is spent on it."""
    if model is None:
        return
    rollout = _simulated_on(model, theta, model.task.start_mean, study.cost)
    if model.task.says_success:
        planned = isinstance(model.policy, Trajectory) and study.method.trajectories > 0
        yield from of_goal(rollout, model, planned, weighed=study.cost.goal_weights is not None)
    else:
        yield from of_starts(theta, model, study.cost)
    yield from of_model(theta, model, study.cost)
    yield from of_draws(rollout, model, study)
    for oddity in model.nominal.oddity(), model.policy.oddity(theta), study.cost.oddity(rollout):
        if oddity is not None:
            yield Remark(*oddity)
    error = model.bias.diagnostics.get("mean_error", 0.0)
    if error > ROUGH:
        yield Remark(
            "a sparse Gaussian process is far from the exact one",
            f"the sparse Gaussian process deviates from the exact one by up to {error:.1f} of the residuals' "
            "root mean square; learn hyper-parameters or raise bias.inducing.points",
        )


def _simulated_on(model: Model, theta: Array, start: Array, cost: Cost) -> Rollout:
    """The rollout of a policy theta (p,), in the closed loop already compiled for searches with this cost."""
    return simulator(model, cost=cost).rollout(theta, start)


def of_reset(iteration: Iteration, max_cost: float) -> Iterator[Remark]:
    """Why the model was cleared after an iteration's search, if it was (line 7 of Algorithm 1)."""
    search = iteration.search
    if search is not None and iteration.learning is not None and iteration.learning.reset:
        yield Remark(
            "model cleared",
            f"model cleared: no policy costs less than Z_max = {max_cost:g} in the corrected simulation "
            f"(best of {search.optimum.evaluations}: {search.predicted_cost:.3g}); is the task "
            "possible within its limits and horizon?",
        )


def of_selection(selection: Selection) -> Iterator[Remark]:
    """Why nothing could be learned from an iteration's experiments, if that is the case."""
    if len(selection.transitions):
        return
    if selection.sampled:
        rejected = ", ".join(f"{name} {count}" for name, count in selection.rejected.items() if count)
        why = f"all {selection.sampled} were rejected: {rejected or 'no reason is given'}"
    else:
        why = selection.note or f"none of {selection.frames} frames was sampled"
    yield Remark("experiments without a sample to learn from", f"no samples to learn from: {why}")


def of_inputs(experiments: Sequence[Rollout], study: Study) -> Iterator[Remark]:
    """A remark if an input changes much from frame to frame in the experiments, which wears a robot."""
    task, options = study.task, study.config.get("policy", {})
    lower, upper = task.input_bounds
    steps = [np.diff(each.inputs, axis=0) / (upper - lower) for each in experiments if each.frames > 1]
    if not steps:
        return
    changes = np.abs(np.concatenate(steps)).mean(axis=0)
    worst = int(np.argmax(changes))
    if changes[worst] > CHATTER:
        without = {"filter_seconds": 0.0, "observer": "none"}
        filters = ", ".join(f"policy.{key}" for key, none in without.items() if options.get(key) == none)
        yield Remark(
            "an input chatters",
            f"{task.inputs[worst].name} changes by {changes[worst]:.0%} of its range from frame to frame, on "
            "average, so motors get hot and gears wear; a larger weight of inputs in the cost may help"
            f"{f', or a filter of noisy rates ({filters})' if filters else ''}",
        )


def of_iteration(iteration: Iteration, earlier: Sequence[Iteration], study: Study) -> list[Remark]:
    """Everything odd about a finished iteration, except a cleared model, which is no fault."""
    found = [*of_policy(iteration.parameters, iteration.model, iteration.search, earlier)]
    found += _of_simulations(iteration, study)
    found += of_inputs(iteration.experiments, study)
    if iteration.learning is not None and not iteration.succeeded:
        found += of_selection(iteration.learning.selection)
    return found


def _of_simulations(iteration: Iteration, study: Study) -> tuple[Remark, ...]:
    """Remarks that require simulations of an iteration's policy, which are run once."""
    if iteration not in _simulated:
        theta, model = iteration.parameters, iteration.model
        starts = [each.states[0] for each in iteration.experiments]
        unsafe = chain.from_iterable(of_safety(theta, start, model, study) for start in starts)
        _simulated[iteration] = *of_prediction(theta, model, study), *islice(unsafe, 1)
    return _simulated[iteration]


def of_trial(iterations: Sequence[Iteration], study: Study) -> list[Remark]:
    """Everything odd about the iterations of a trial."""
    found = (of_iteration(each, iterations[:index], study) for index, each in enumerate(iterations))
    return [remark for remarks in found for remark in remarks]
