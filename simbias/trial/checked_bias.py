"""A learner whose fitted bias is checked against the contract before any simulation uses it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np

from simbias.core import Bias, FittedBias, Nominal, Task
from simbias.core.error_origin import written_at
from simbias.core.messages import quote
from simbias.core.records import Rollout, Transitions

POINTS = 64  # about as many data are checked: an exact posterior at all of them takes as long as its fit


class CheckedBias(Bias):
    """A learner whose correction is checked at its data or, without data, at the task's mean start."""

    def __init__(self, bias: Bias, task: Task) -> None:
        self._bias, self._task = bias, task

    def fit(self, transitions: Transitions) -> FittedBias:
        """Learn from the data; a ValueError if the result is no bias, has a wrong shape or is not finite."""
        return self._checked("fit", self._bias.fit(transitions), transitions)

    def learn(self, transitions: Transitions, rollouts: Sequence[Rollout], nominal: Nominal) -> FittedBias:
        """Learn from the data, or from the rollouts and the nominal model; errors as for `fit`."""
        method = "fit" if type(self._bias).learn is Bias.learn else "learn"
        return self._checked(method, self._bias.learn(transitions, rollouts, nominal), transitions)

    @np.errstate(all="ignore")  # as in simulations
    def _checked(self, method: str, fitted: FittedBias, data: Transitions) -> FittedBias:
        """The bias that a method returned, if it is valid."""
        if not isinstance(fitted, FittedBias):
            _refuse(self._bias, method, "a FittedBias", quote(fitted))
        start = np.concatenate([self._task.start_mean, np.zeros(len(self._task.inputs))])[None]
        points = data.inputs[:: 1 + len(data) // POINTS] if len(data) else start
        x, u = np.split(points, [len(self._task.states)], axis=1)
        g = np.asarray(fitted.correction(x.copy(), u.copy()), np.float64)
        if g.shape != x.shape:
            _refuse(fitted, "correction", f"the shape {x.shape}", g.shape)
        if not (finite := np.isfinite(g)).all():
            _refuse(fitted, "correction", "finite numbers", g[~finite][0])
        return fitted


def _refuse(component: Any, method: str, expected: str, got: Any) -> NoReturn:
    """Report which method broke its contract, and where it is defined."""
    place = written_at(component, method)
    raise ValueError(f"{type(component).__name__}.{method}: expected {expected}, got {got} ({place})")
