"""Ask and tell: a trial that asks the caller for each experiment and receives its rollout."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from simbias.core import Hardware, HardwareError, Policy, Task, Waiting
from simbias.core.records import Array, Iteration, Optimum, Rollout
from simbias.lab.checked_hardware import MakeExperiment
from simbias.lab.checks import check_rollout
from simbias.lab.rates import check_rates, rates_of
from simbias.lab.requests.measurements import tell_other_commands
from simbias.lab.requests.request import ExperimentRequest
from simbias.lab.safety import without_limits
from simbias.lab.targets import WithTargets, beside
from simbias.trial.replay import EndOfRecord, Record

SOURCE = "study.tell"
AGAIN = "simbias: %s: got the rollout of experiment %d again, although this request has another start"


class AskTell:
    """A trial whose experiments are run by the caller.

    Each `ask` reruns the trial and replays its steps, so the trial is the same as with its own hardware.
    `run` runs the trial over a record's steps with a substitute hardware.
    """

    def __init__(self, task: Task, run: Callable[[Record, Hardware], Iterator[Iteration]]) -> None:
        self._task = task
        self._run = run
        self._told: list[Rollout] = []
        self._answers: list[tuple[ExperimentRequest, Rollout]] = []  # the told rollouts, with their requests
        self._optima: list[Optimum] = []
        self._request: ExperimentRequest | None = None
        self.iterations: tuple[Iteration, ...] = ()  # those that have ended

    def ask(self) -> ExperimentRequest | None:
        """The next experiment; None once the trial has ended."""
        if self._request is not None:
            return self._request
        iterations: list[Iteration] = []
        steps, asking = _Steps(self._told, self._optima), _Asking(self._task)
        try:
            for iteration in self._run(steps, asking):
                iterations.append(iteration)
        except EndOfRecord:
            self._request = asking.request
        self.iterations = tuple(iterations)
        return self._request

    def tell(self, rollout: Rollout) -> None:
        """Take the rollout of the requested experiment; errors as for `Study.tell`."""
        if self._request is None:
            raise ValueError("no experiment was asked for; call ask() first")
        request = self._request
        checked = check_rollout(rollout, SOURCE, self._task, request.bounds, request.start)
        check_rates(SOURCE, [checked], self._task, rates_of(self._task))
        tell_other_commands(checked.states, checked.inputs, request, SOURCE)
        for number, (asked, each) in enumerate(self._answers, 1):
            if np.array_equal(each.states, checked.states) and np.array_equal(each.inputs, checked.inputs):
                before, now = asked.content(), request.content()
                if before["policy"] != now["policy"]:
                    raise HardwareError(
                        f"{SOURCE}: is the answer to another request, that of experiment {number}"
                    )
                if before != now:  # a noise-free robot may ignore the requested start
                    logging.getLogger(__name__).warning(AGAIN, SOURCE, number)
        self._answers.append((request, checked))
        policy = without_limits(request.policy)
        targets = policy.targets if isinstance(policy, WithTargets) else np.empty(0)
        self._told.append(beside(replace(checked, parameters=request.theta), targets))
        self._request = None


class _Asking(Hardware):
    """Requests the experiment instead of running it."""

    sets_start = False

    def __init__(self, task: Task) -> None:
        self._task = task
        self.request: ExperimentRequest | None = None

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """End the trial's run at this experiment."""
        token = int(rng.integers(2**62))
        self.request = ExperimentRequest(self._task, policy, theta, start, token)
        raise _AskedError("the experiment that was asked for")


class _AskedError(Waiting, EndOfRecord):
    """The rollout of the requested experiment has not been told yet."""


class _Steps(Record):
    """The known steps of a trial; optima of further searches are added."""

    def __init__(self, told: Sequence[Rollout], optima: list[Optimum]) -> None:
        self._experiments, self._optima, self._searches = iter(told), optima, iter(tuple(optima))

    def search(self, make: Callable[[], Optimum]) -> Optimum:
        """The next search, from memory if known."""
        optimum = next(self._searches, None)
        if optimum is None:
            optimum = make()
            self._optima.append(optimum)
        return optimum

    def experiment(self, theta: Array, rng: np.random.Generator, make: MakeExperiment) -> Rollout:
        """The next told experiment; if there is none, `make` requests it."""
        return next(self._experiments, None) or make(rng)
