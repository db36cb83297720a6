"""Observers of a trial, which show its progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from simbias.core import Model
from simbias.core.records import Array, Iteration, Rollout, Search


class Observer:
    """Follows a trial; the base class does nothing."""

    def searching(self, evaluations: int, best_cost: float) -> None:
        """A policy search has simulated this number of policies; a few may be wasted if it looks ahead."""

    def designed(self, theta: Array, model: Model | None = None, search: Search | None = None) -> None:
        """A policy theta (p,) was made, on this model and by this search, if there are any."""

    def experimenting(self, theta: Array, start: Array) -> None:
        """A hardware experiment with theta (p,) from start (n,) begins."""

    def experimented(self, rollout: Rollout) -> None:
        """A hardware experiment has ended."""

    def iterated(self, iteration: Iteration) -> None:
        """An iteration has ended."""

    def trying(self, number: int, count: int) -> None:
        """A test episode of the last policy begins; the first has the number 0."""


class Observers(Observer):
    """Several observers as one."""

    def __init__(self, *observers: Observer) -> None:
        for event in (name for name in vars(Observer) if not name.startswith("_")):
            setattr(self, event, partial(_each, [getattr(observer, event) for observer in observers]))


def _each(functions: Sequence[Callable[..., None]], *arguments: Any) -> None:
    """Call each function."""
    for function in functions:
        function(*arguments)
