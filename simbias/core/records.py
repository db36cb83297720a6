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

MEMORY = 1000  # frames of a constant input that bring a model state to its steady value


@dataclass(frozen=True, eq=False, repr=False)
class Rollout:
    """One run of a policy, in simulation or on hardware, up to its failure or to the horizon T.

    An experiment's states, inputs and measurements are read-only.
    """

    states: Array  #: (k+1, n) recorded states x_0 .. x_k; k = T, or the frame of the failure
    inputs: Array  #: (k, m) commanded inputs u_0 .. u_{k-1}
    failed_at: int | None = None  #: t_fail of Eq. 8: the failing frame, or the last before an engine diverged
    failure: str | None = None  #: name of the violated criterion (Section IV-C)
    cost: float = math.nan  #: Z of Eq. 8; nan until a cost has judged the rollout
    measured: Array | None = None  #: (k+1, n) the sensors' readings; None without sensors
    sensed: bool = False  #: whether `states` are these readings, as on a real robot; else the true states
    noise: Array | None = None  #: (n,) standard deviations of white noise in `states`; None: unknown
    parameters: Array = field(default_factory=lambda: np.empty(0))  #: (p,); set by the study that ran it
    given_start: bool = False  #: whether a method chose the experiment's start; else the task drew it
    source: str | None = None  #: the file it was read from, if a person provided it
    earlier: Rollout | None = None  #: the part of its recording before it
    continues: bool = False  #: whether it follows a gap in a recording: earlier inputs are unknown

    def __repr__(self) -> str:
        """The rollout in a line, e.g. in a notebook."""
        end = "" if self.failed_at is None else f", failed: {self.failure}"
        return f"<rollout of {self.frames} frames, cost {self.cost:.3g}{end}>"

    @property
    def frames(self) -> int:
        """The number k of frames in which the robot was controlled."""
        return len(self.inputs)

    def read_only(self) -> Rollout:
        """The rollout itself; nothing can be written into its states, inputs and measurements any more."""
        for array in (self.states, self.inputs, self.measured):
            if array is not None:
                array.flags.writeable = False
        return self

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
        """The rollout with only the first n states."""
        if n == self.states.shape[1]:
            return self
        measured = None if self.measured is None else self.measured[:, :n]
        noise = None if self.noise is None else self.noise[:n]
        earlier = None if self.earlier is None else self.earlier.of_states(n)
        return replace(self, states=self.states[:, :n], measured=measured, noise=noise, earlier=earlier)

    def with_history(self) -> tuple[Array, Array, int]:
        """States (h+k+1, n), inputs (h+k, m) and h, the earlier frames in them, as many as models remember.

        After a gap, its first input is assumed to have acted before. Without a gap, no input acted before.
        """
        states, inputs = self.states, self.inputs
        if self.earlier is not None:
            before, sent, _ = self.earlier.with_history()
            states, inputs = np.concatenate([before[:-1], states]), np.concatenate([sent, inputs])
        elif self.continues and inputs[:1].any():
            states, inputs = (np.pad(each, ((MEMORY, 0), (0, 0)), "edge") for each in (states, inputs))
        earlier = min(len(inputs) - self.frames, MEMORY)
        begin = len(inputs) - self.frames - earlier
        return states[begin:], inputs[begin:], earlier


@dataclass(frozen=True, eq=False)
class Disturbance:
    """Noise on one simulated rollout, frame by frame."""

    inputs: Array  #: (T, m) added to the inputs that act on the model
    sensors: Array  #: (T+1, n) added to the states that the policy sees


@dataclass(frozen=True, eq=False)
class Transitions:
    """Training data D of the dynamics bias (Section IV-C), in the task's units; read-only."""

    inputs: Array  #: (N, n+m) x~_t = (x_{t-1}, u_{t-1}), u the acting input (`Nominal.acted`)
    residuals: Array  #: (N, n) Delta_t of Eq. 6

    def __post_init__(self) -> None:
        for array in (self.inputs, self.residuals):
            array.flags.writeable = False  # the data are recorded, and reused for learning

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

    transitions: Transitions  #: the samples
    frames: int  #: transitions that the rollouts hold
    sampled: int  #: those left after downsampling
    rejected: Mapping[str, int]  #: criterion -> number of sampled transitions that it rejected
    note: str = ""  #: explains to a person why nothing was sampled


@dataclass(frozen=True, eq=False)
class Optimum:
    """The result of a policy search."""

    parameters: Array  #: (p,)
    cost: float  #: Z of these parameters in the search
    evaluations: int  #: number of policies evaluated
    stopped_by: str  #: why the search ended, in words
    flat: bool = False  #: whether all policies that it evaluated cost the same


@dataclass(frozen=True, eq=False)
class Search:
    """A policy search in simulation (lines 4 and 5 of Algorithm 1)."""

    optimum: Optimum  #: its result
    predicted_cost: float  #: Z_g


@dataclass(frozen=True, eq=False)
class Learning:
    """Learning from an iteration's experiments (lines 6-8 and 13)."""

    selection: Selection  #: D_i
    data: Transitions  #: D afterwards
    reset: bool = False  #: whether D was cleared before
    log_likelihoods: Mapping[str, float] = field(default_factory=dict)  #: nats, of each model variant, if any


@dataclass(frozen=True, eq=False, repr=False)
class Iteration:
    """One pass through the loop of a method, with the parts that the method has."""

    index: int  #: i, from 0
    parameters: Array  #: (p,) the policy that it ended with
    experiments: tuple[Rollout, ...]  #: line 9; with several policies, if the method tries several
    hardware_cost: float  #: Z_r of that policy: the maximum over its experiments
    succeeded: bool  #: line 10
    total_experiments: int  #: hardware experiments of the trial so far
    model: Model | None = None  #: the simulation model that its policy was searched or designed on
    search: Search | None = None  #: lines 4 and 5
    learning: Learning | None = None  #: lines 6 to 8, and 13
    seconds: Mapping[str, float] = field(default_factory=dict)  #: wall time of each phase

    def __repr__(self) -> str:
        """The iteration in a line, e.g. in a notebook."""
        ended = "succeeded" if self.succeeded else "not succeeded"
        made = f"hardware cost {self.hardware_cost:.3g}, {self.total_experiments} experiments so far"
        return f"<iteration {self.index}: {ended}, {made}>"
