"""A trial turned inside out: it asks for experiments, and is told what came of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from simbias.core import Hardware, Optimizer, Policy, Task, Waiting
from simbias.core.records import Array, Iteration, Optimum, Rollout
from simbias.lab.checks import check_rollout
from simbias.lab.requests.order import Order
from simbias.trial.replay import RecallingOptimizer

Run = Callable[[Hardware, Optimizer], Iterator[Iteration]]  # a trial with these


class Dialogue:
    """What a trial has been told so far.

    Each question begins the trial anew and recalls experiments and searches, as a trial that is started again
    does; so the answer is the same as if the hardware had been there.

    Parameters
    ----------
    task
        The trial's.
    optimizer
        Likewise.
    run
        The trial, with another hardware and optimizer.
    """

    def __init__(self, task: Task, optimizer: Optimizer, run: Run) -> None:
        self._task = task
        self._run = run
        self._told: list[Rollout] = []
        self._optimizer = _Remembering(optimizer)
        self._order: Order | None = None
        self.iterations: tuple[Iteration, ...] = ()  # those that have ended

    def ask(self) -> Order | None:
        """The next experiment; None once the trial has come to its end."""
        if self._order is not None:
            return self._order
        iterations: list[Iteration] = []
        self._optimizer.begin()
        try:
            for iteration in self._run(_Told(self._task, self._told), self._optimizer):
                iterations.append(iteration)
        except _AskedError as asked:
            self._order = asked.order
        self.iterations = tuple(iterations)
        return self._order

    def tell(self, rollout: Rollout) -> None:
        """What came of the experiment that was asked for.

        Raises
        ------
        ValueError
            If none was asked for.
        HardwareError
            If the rollout is not what the contract asks for; the question stays open.
        """
        if self._order is None:
            raise ValueError("no experiment was asked for: ask() comes first")
        checked = check_rollout(rollout, _Told(self._task, ()), self._task)
        self._told.append(replace(checked, parameters=self._order.theta))
        self._order = None


class _AskedError(Waiting):
    """An experiment that nobody has told of."""

    def __init__(self, order: Order) -> None:
        super().__init__(order.name)
        self.order = order


class _Told(Hardware):
    """Returns what was told, in its order."""

    sets_start = False

    def __init__(self, task: Task, told: Sequence[Rollout]) -> None:
        self._task = task
        self._told = iter(tuple(told))

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """The next one."""
        rollout = next(self._told, None)
        if rollout is None:
            raise _AskedError(Order(self._task, policy, theta, start, int(rng.integers(2**62))))
        return rollout


class _Remembering(RecallingOptimizer):
    """An optimizer that remembers, as long as the dialogue lasts."""

    def __init__(self, optimizer: Optimizer) -> None:
        super().__init__(optimizer)
        self._optima: list[Optimum] = []
        self._next = 0

    def begin(self) -> None:
        """The trial begins anew."""
        self._next = 0

    def recall(self) -> Optimum | None:
        """The next one."""
        self._next += 1
        return self._optima[self._next - 1] if self._next <= len(self._optima) else None

    def keep(self, optimum: Optimum) -> None:
        """Remember it."""
        self._optima.append(optimum)
