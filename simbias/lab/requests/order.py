"""An experiment to be made by a person or a program: the policy, the start, the limits."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from simbias.core import Controller, Policy, Quantity, Task
from simbias.core.records import Array
from simbias.lab.safety import Bounds, Guarded

FORMAT = 1  # of an order: raised when what is in it changes its meaning
DIGITS = 8  # hexadecimal, of an order's name


@dataclass(frozen=True, eq=False)
class Order:
    """Run theta (p,) of a policy from a start (n,), for the task's horizon or until it fails."""

    task: Task
    policy: Policy
    theta: Array  # (p,)
    start: Array  # (n,)
    token: int = 0  # tells orders apart that are the same in all else

    @property
    def name(self) -> str:
        """What tells the order apart: the same whenever the same experiment of a trial is asked for."""
        text = json.dumps([self.theta.tolist(), self.start.tolist(), self.token])
        return hashlib.sha256(text.encode()).hexdigest()[:DIGITS]

    def controller(self) -> Controller:
        """What computes the input of each frame."""
        return self.policy.controller(self.theta, self.task.time_step)

    @property
    def bounds(self) -> Bounds:
        """The limits at which the experiment is to be aborted."""
        if isinstance(self.policy, Guarded):
            return self.policy.bounds_of_safety
        n, m = len(self.task.states), len(self.task.inputs)
        return Bounds(self.task.input_limit, np.full(m, np.inf), np.full(n, np.inf), False)

    def content(self) -> dict[str, Any]:
        """The order in plain containers, as JSON takes them; null is no limit."""
        task, law, bounds = self.task, self.policy.law(self.theta), self.bounds
        return {
            "format": FORMAT,
            "order": self.name,
            "policy": {
                "class": type(getattr(self.policy, "policy", self.policy)).__name__,
                "law": law.words,
                **{name: np.asarray(values).tolist() for name, values in law.numbers.items()},
                "parameters": self.theta.tolist(),
            },
            "states": [
                {**each, "start": float(start), "limit": _limit(limit)}
                for each, start, limit in zip(_named(task.states), self.start, bounds.states, strict=True)
            ],
            "inputs": [
                {**each, "limit": _limit(limit), "limit_of_change_per_s": _limit(rate)}
                for each, limit, rate in zip(
                    _named(task.inputs), bounds.inputs, bounds.input_rates, strict=True
                )
            ],
            "outputs": _named(task.outputs),
            "time_step": task.time_step,
            "rate": 1.0 / task.time_step,
            "frames": task.horizon,
            "duration": task.horizon * task.time_step,
            "failure": [
                {"name": each.name, "words": each.words, "limit": float(each.limit), "unit": each.unit}
                for each in task.criteria
            ],
        }

    def text(self) -> str:
        """The order as JSON."""
        return json.dumps(self.content(), indent=2, allow_nan=False) + "\n"


def _named(quantities: Sequence[Quantity]) -> list[dict[str, Any]]:
    """Names and units."""
    return [{"name": quantity.name, "unit": quantity.unit} for quantity in quantities]


def _limit(value: float) -> float | None:
    """A limit, None where there is none."""
    return float(value) if np.isfinite(value) else None
