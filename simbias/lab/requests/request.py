"""A request for an experiment by a person or a program: the policy, the start, the limits."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from simbias.core import Controller, Policy, Quantity, Task
from simbias.core.digest import short_digest
from simbias.core.records import Array
from simbias.lab.checks import start_tolerance
from simbias.lab.requests.controller import c_header, python_module
from simbias.lab.requests.verification import difference
from simbias.lab.safety import NO_LIMITS, Bounds, SafetyLimitedPolicy, without_limits
from simbias.lab.targets import WithTargets
from simbias.simulation.compiler import NUMPY, Formulas, formulas_of

FORMAT = 1  # of a request: incremented when the meaning of its content changes
HEADER, MODULE = "controller.h", "controller.py"


@dataclass(frozen=True, eq=False)
class ExperimentRequest:
    """A request to run theta (p,) of a policy from a start (n,), for the task's horizon or until failure."""

    task: Task
    policy: Policy
    theta: Array  #: (p,)
    start: Array  #: (n,)
    token: int = 0  #: distinguishes otherwise identical requests

    @cached_property
    def name(self) -> str:
        """A hash of the request's content and of its controller's formulas."""
        formulas = None if isinstance(self.formulas, str) else self.formulas.written(NUMPY)
        said = [self.content(), formulas, self.token]
        return short_digest(json.dumps(said, sort_keys=True).encode())

    def controller(self) -> Controller:
        """The controller that computes the input of each frame, and raises UnsafeError beyond the limits."""
        policy = self.policy
        if not isinstance(policy, SafetyLimitedPolicy):  # also here, what is not a number aborts
            policy = SafetyLimitedPolicy(policy, self.task, self.bounds)
        return policy.controller(self.theta, self.task.time_step)

    @property
    def bounds(self) -> Bounds:
        """The limits at which the experiment is to be aborted."""
        if isinstance(self.policy, SafetyLimitedPolicy):
            return self.policy.safety_bounds
        return NO_LIMITS.bounds(self.task)

    @property
    def targets(self) -> list[str]:
        """The targets of the experiment, which its policy knows, in words."""
        policy = without_limits(self.policy)
        return policy.texts if isinstance(policy, WithTargets) else []

    @cached_property
    def formulas(self) -> Formulas | str:
        """The controller's formulas, or the reason why there are none."""
        aborting = self.bounds.criteria and isinstance(self.policy, SafetyLimitedPolicy)
        return formulas_of(self.policy, self.task, self.theta, "act_within_criteria" if aborting else "act")

    @cached_property
    def why_no_code(self) -> str:
        """Why the controller is not available as code; "" if its code agrees with the policy."""
        law = self.formulas
        if isinstance(law, str):
            return law
        found = self._difference(law, self.bounds)
        plain = formulas_of(self.policy, self.task, self.theta)
        if found or isinstance(plain, str) or not plain.time_dependent:
            return found
        return self._difference(plain, NO_LIMITS.bounds(self.task), whole=True)  # no limit ends it earlier

    def _difference(self, law: Formulas, bounds: Bounds, whole: bool = False) -> str:
        """How the law as code, within these limits, differs from the policy; "" if it agrees."""
        written = _written(self.task, law, "", bounds)
        return difference(self.policy, self.task, self.theta, bounds, *written, whole)

    def code(self, title: str) -> dict[str, str]:
        """The controller in C and in Python, by file name; empty without formulas."""
        law = self.formulas
        if isinstance(law, str):
            return {}
        return dict(zip((HEADER, MODULE), _written(self.task, law, title, self.bounds), strict=True))

    def text(self) -> str:
        """The request as JSON; null means no limit."""
        content = {"format": FORMAT, "request": self.name, **self.content()}
        return json.dumps(content, indent=2, allow_nan=False) + "\n"

    def content(self) -> dict[str, Any]:
        """The content of the request, in plain containers."""
        task, law, bounds = self.task, self.policy.law(self.theta), self.bounds
        policy = without_limits(self.policy)
        policy = policy.policy if isinstance(policy, WithTargets) else policy
        states = zip(_named(task.states), self.start, start_tolerance(task), bounds.states, strict=True)
        inputs = zip(_named(task.inputs), *bounds.input_bounds, bounds.input_rates, strict=True)
        return {
            "policy": {
                "class": type(policy).__name__,
                "law": law.words,
                **{name: np.asarray(values).tolist() for name, values in law.numbers.items()},
                "parameters": self.theta.tolist(),
            },
            "states": [
                {
                    **named,
                    "start": float(start),
                    "start_tolerance": _limit(tolerance),
                    "limit": _limit(limit),
                }
                for named, start, tolerance, limit in states
            ],
            "inputs": [
                {**named, **_limits(lower, upper), "limit_of_change_per_s": _limit(rate)}
                for named, lower, upper, rate in inputs
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


def _written(task: Task, law: Formulas, title: str, bounds: Bounds) -> tuple[str, str]:
    """The law in C and in Python."""
    return c_header(task, law, title, bounds), python_module(task, law, title, bounds)


def _named(quantities: Sequence[Quantity]) -> list[dict[str, Any]]:
    return [{"name": quantity.name, "unit": quantity.unit} for quantity in quantities]


def _limits(lower: float, upper: float) -> dict[str, float | None]:
    """The limit of an input's size or, if it is not symmetric, on each side."""
    if lower == -upper:
        return {"limit": _limit(upper)}
    return {"lower_limit": _limit(lower), "upper_limit": _limit(upper)}


def _limit(value: float) -> float | None:
    """A limit; None if there is none."""
    return float(value) if np.isfinite(value) else None
