"""The records that flow through a study: frozen, with the shape of every array."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from simbias.core.model import Model

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

MEMORY = 1000  # frames, after which the model state is that of a steady input


@dataclass(frozen=True, eq=False)
class Rollout:
    """One run of a policy, in simulation or on hardware, up to its failure or to the horizon T."""

    states: Array  # (k+1, n) recorded states x_0 .. x_k; k = T, or the failing frame
    inputs: Array  # (k, m) commanded inputs u_0 .. u_{k-1}
    failed_at: int | None = None  # t_fail of Eq. 8: the frame that failed, or after which an engine blew up
    failure: str | None = None  # name of the criterion of Section IV-C that failed
    cost: float = math.nan  # Z of Eq. 8; nan until a cost has judged the rollout
    measured: Array | None = None  # (k+1, n) what the sensors said; None where nothing was sensed
    sensed: bool = False  # whether the recorded states are these, as on a real robot; else the true ones
    parameters: Array = field(default_factory=lambda: np.empty(0))  # (p,); set by the study that ran it
    source: str | None = None  # the file that a person put, if it was read from one
    earlier: Rollout | None = None  # what its recording holds before it
    continues: bool = False  # whether it follows a gap in a recording: an input had acted which nobody knows

    @property
    def frames(self) -> int:
        """The number k of frames in which the robot was controlled."""
        return len(self.inputs)

    def part(self, begin: int, end: int) -> Rollout:
        """The frames from `begin` up to `end`; a failure is in the part that reaches it."""
        failed = self.failed_at is not None and end == self.frames
        return replace(
            self,
            states=self.states[begin : end + 1],
            inputs=self.inputs[begin:end],
            measured=None if self.measured is None else self.measured[begin : end + 1],
            failed_at=end - begin if failed else None,
            failure=self.failure if failed else None,
            earlier=self.part(0, begin) if begin else self.earlier,
            continues=self.continues and not begin,
        )

    def of_states(self, n: int) -> Rollout:
        """The rollout with the first n of its states alone."""
        if n == self.states.shape[1]:
            return self
        measured = None if self.measured is None else self.measured[:, :n]
        earlier = None if self.earlier is None else self.earlier.of_states(n)
        return replace(self, states=self.states[:, :n], measured=measured, earlier=earlier)

    def with_history(self) -> tuple[Array, Array]:
        """States (h+k+1, n) and inputs (h+k, m), from h frames before it on, as far back as models remember.

        After a gap, its first input is taken for what had acted; at rest, and without a gap, nothing had.
        """
        states, inputs = self.states, self.inputs
        if self.earlier is not None:
            before, sent = self.earlier.with_history()
            states, inputs = np.concatenate([before[:-1], states]), np.concatenate([sent, inputs])
        elif self.continues and inputs[:1].any():
            states, inputs = (np.pad(each, ((MEMORY, 0), (0, 0)), "edge") for each in (states, inputs))
        begin = max(0, len(inputs) - self.frames - MEMORY)
        return states[begin:], inputs[begin:]


@dataclass(frozen=True, eq=False)
class Disturbance:
    """Noise on one simulated rollout, frame by frame."""

    inputs: Array  # (T, m) added to what acts on the model
    sensors: Array  # (T+1, n) added to what the policy sees


@dataclass(frozen=True, eq=False)
class Transitions:
    """Training data D of the dynamics bias (Section IV-C), in the task's units; nothing may write into it."""

    inputs: Array  # (N, n+m) x~_t = (x_{t-1}, u_{t-1}), u what acted (`Nominal.acted`)
    residuals: Array  # (N, n) Delta_t of Eq. 6

    def __post_init__(self) -> None:
        for array in (self.inputs, self.residuals):
            array.flags.writeable = False  # they are recorded, and learned from again

    def __len__(self) -> int:
        return len(self.inputs)

    def __or__(self, other: Transitions) -> Transitions:
        """D union D_i (line 13 of Algorithm 1)."""
        return Transitions(
            inputs=np.concatenate([self.inputs, other.inputs]),
            residuals=np.concatenate([self.residuals, other.residuals]),
        )

    @staticmethod
    def empty(n: int, m: int) -> Transitions:
        """D = {} (line 1 of Algorithm 1), for n states and m inputs."""
        return Transitions(inputs=np.empty((0, n + m)), residuals=np.empty((0, n)))


@dataclass(frozen=True)
class Selection:
    """Training data selected from rollouts, and counts of rejected samples by criterion (Section IV-C)."""

    transitions: Transitions
    frames: int  # transitions that the rollouts hold
    sampled: int  # those left after downsampling
    rejected: Mapping[str, int]  # criterion -> how many of the sampled ones it rejected
    note: str = ""  # what else a person should know where nothing was sampled


@dataclass(frozen=True, eq=False)
class Optimum:
    """The result of a policy search."""

    parameters: Array  # (p,)
    cost: float
    evaluations: int
    stopped_by: str  # why the search ended, in words
    flat: bool = False  # whether all policies that it evaluated cost the same


@dataclass(frozen=True, eq=False)
class Search:
    """A policy search in simulation (lines 4 and 5 of Algorithm 1)."""

    optimum: Optimum
    predicted_cost: float  # Z_g


@dataclass(frozen=True, eq=False)
class Learning:
    """Learning from an iteration's experiments (lines 6-8 and 13)."""

    selection: Selection  # D_i
    data: Transitions  # D afterwards
    reset: bool = False  # whether D was cleared before
    log_likelihoods: Mapping[str, float] = field(default_factory=dict)  # of each model variant, if any, nats


@dataclass(frozen=True, eq=False)
class Iteration:
    """One pass through the loop of a method, with those parts that the method has."""

    index: int  # i, from 0
    parameters: Array  # (p,) the policy that it arrived at
    experiments: tuple[Rollout, ...]  # line 9; of several policies, where a method tries several
    hardware_cost: float  # Z_r of that policy: the maximum over its experiments
    succeeded: bool  # line 10
    total_experiments: int  # hardware experiments of the trial so far
    model: Model | None = None  # the simulation that its policy was made on, by a search or without
    search: Search | None = None
    learning: Learning | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)  # wall time of each phase
