"""Policies: feedback laws with searched parameters, and the controller that runs a policy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np

from simbias.core.records import Array

if TYPE_CHECKING:
    from simbias.core.model import Nominal

SAME = 1e-6  # of a policy's largest parameter: smaller differences are ignored


class Law(NamedTuple):
    """A policy in words and numbers, for requests to a lab."""

    words: str  #: for example, u = H z
    numbers: Mapping[str, Array]  #: the symbols in the words, in the task's units


class Policy(ABC):
    """A feedback law with parameters theta, which are searched.

    A law with a filter, an integral or a delay has a policy state, which is zero at the start.
    """

    n_parameters: int  #: p
    bounds: tuple[Array, Array]  #: lower (p,), upper (p,)
    state_size: int = 0  #: s, of the policy state

    @abstractmethod
    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        """Inputs u (..., m) within the task's limits, and the policy state (..., s) for the next frame.

        Arguments: theta (..., p), (measured) states x (..., n), time t in s since the start. Most laws ignore
        the time and return the policy state unchanged.
        """

    def designed_on(self, nominal: Nominal) -> Self:
        """The policy with its model-based parts redesigned on this (identified) model; by default itself.

        The number and meaning of its parameters stay.
        """
        return self

    def directions(self, theta: Array) -> Array:
        """Directions (d, p), none of them zero, of a search near the policy theta (p,), from -1 to 1 of each.

        By default there are none, for any theta, and the box is searched.
        """
        return np.empty((0, len(theta)))

    def imitating(self, states: Array, inputs: Array) -> Array | None:
        """The parameters (p,) that best imitate inputs (k, T, m) at states (k, T, n); None if unsupported.

        There are k records of T frames; their inputs may use more information than the policy has.
        """
        return None

    def integrated(self, x: Array) -> Array:
        """Quantities (..., i) at states x (..., n) that the policy integrates over time; none by default."""
        return x[..., :0]

    def oddity(self, theta: Array) -> tuple[str, str] | None:
        """An oddity of the policy theta (p,), in few words and in a sentence; None if there is none."""
        return None

    def law(self, theta: Array) -> Law:
        """The policy theta (p,) for people and programs without simbias, as far as it can be written down."""
        return Law(f"u = {type(self).__name__}.act(theta, x, t, policy_state)", {"theta": theta})

    def controller(self, theta: Array, time_step: float) -> Controller:
        """The policy theta (p,) as a controller for a control loop, called once a frame of `time_step` s."""
        return Controller(self, theta, time_step)


class Controller:
    """A policy in a control loop: u (m,) = controller(x), called once a frame; it tracks time and state."""

    def __init__(self, policy: Policy, theta: Array, time_step: float) -> None:
        self._policy = policy
        self._theta = theta
        self._time_step = time_step
        self._frame = 0
        self.policy_state = np.zeros(policy.state_size)

    def __call__(self, x: Array) -> Array:
        """Input u (m,) of the next frame, at the (measured) state x (n,), given as numbers of any type."""
        time, own = self._frame * self._time_step, np.array(x, dtype=np.float64)  # its own copy
        u, self.policy_state = self._policy.act(self._theta, own, time, self.policy_state)
        self._frame += 1
        return u


def same_policy(theta: Array, other: Array) -> bool:
    """Whether policies (p,) are the same; plans are recomputed, and differ in their last digits."""
    return np.allclose(other, theta, rtol=SAME, atol=SAME * np.abs(theta).max(initial=0.0))
