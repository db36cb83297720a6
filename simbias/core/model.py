"""The simulation model of a robot, its parameters, the data, and the bias learned from them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from simbias.core.parameters import Estimate, Parameter, values_at
from simbias.core.policy import Policy
from simbias.core.records import Array, Rollout, Selection, Transitions
from simbias.core.robot import Task

MOST_DRAWS = 1000  # of parameters, before giving up on finding feasible ones


class Kernel(NamedTuple):
    """A component's function in the compiled closed loop: see `simbias.simulation.compiler.kernels`.

    Without a kernel, the component's method is traced if it is ordinary vectorised NumPy.
    """

    function: Callable
    parameters: Any  #: an array; for a bias that works on all lanes, a tuple of arrays


class Nominal(ABC):
    """The simulation model f' (Section IV-A).

    Effects that the state does not show, such as an actuator's lag or a delay, are kept in a model state. It
    is zero at the start of a rollout (`simbias.simulation.actuator`), but not at the start of a part of one
    (`Rollout.with_history`). The bias is a function of the commanded input (Eq. 2) or, if the model state
    keeps it, of the input that acts.
    """

    kernel: Kernel | None = None
    parameters: tuple[Parameter, ...] = ()  #: those that are not known exactly
    state_size: int = 0  #: s, of the model state
    acting: tuple[int, ...] = ()  #: entries of the model state that keep the acting input; see `acted`
    estimates: Sequence[Estimate] = ()  #: what has been identified
    diagnostics: Mapping[str, float] = MappingProxyType({})  #: of the identification's fit

    @abstractmethod
    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n) = x + f'(x, u), one time step after x (..., n) under u (..., m) (Eq. 1).

        A model with a model state steps as if u had been constant for long.
        """

    def advance(self, x: Array, u: Array, model_state: Array) -> tuple[Array, Array]:
        """x_next (..., n), and the model state (..., s) for the next frame; for models that have one."""
        return self.step(x, u), model_state

    def acted(self, u: Array, model_state: Array) -> Array:
        """Input (..., m) that a bias depends on: u, or what acted in the frame that led to this state."""
        return model_state[..., self.acting] if self.acting else u

    def model_states(self, states: Array, inputs: Array) -> Array:
        """Model states (k, s) in each frame of a record with states (k, n) and inputs (k, m)."""
        kept, model_state = np.zeros((len(inputs), self.state_size)), np.zeros(self.state_size)
        for t in range(len(inputs) if self.state_size else 0):
            kept[t] = model_state
            _, model_state = self.advance(states[t], inputs[t], model_state)
        return kept

    def along(self, states: Array, inputs: Array) -> Array:
        """x_next (k, n) predicted from each state (k, n) of a recorded rollout under its inputs (k, m).

        Model states, which are not recorded, are simulated from the earlier inputs.
        """
        if not self.state_size:
            return self.step(states, inputs)
        return self.advance(states, inputs, self.model_states(states, inputs))[0]

    def acted_along(self, states: Array, inputs: Array) -> Array:
        """Inputs (k, m) that a bias depends on, along a recorded rollout: see `along`, `acted`."""
        if not self.acting:
            return inputs
        return self.acted(inputs, self.advance(states, inputs, self.model_states(states, inputs))[1])

    def with_parameters(self, values: Array) -> Nominal:
        """The model with other values (k,) of its `parameters`, in their units.

        The returned model's `parameters` keep their priors, or are at these values.
        """
        raise NotImplementedError(f"{type(self).__name__} has parameters, but no `with_parameters`")

    def oddity(self) -> tuple[str, str] | None:
        """An oddity of the identified model, in few words and in a sentence; None if there is none."""
        return None

    @property
    def slack(self) -> Array:
        """Slack (c,) of each constraint on the parameters; below 0, no robot can have them."""
        return np.empty(0)

    def without_dry_friction(self) -> Nominal:
        """The model without dry friction, which is steeper at rest than any damping."""
        return self

    def without_input_limits(self) -> Nominal:
        """The model without input limits: a motor model in front of it may exceed the commanded input."""
        return self

    def draw(self, rng: np.random.Generator) -> Nominal:
        """A model with parameters drawn from what is known of them; this model if they are known exactly."""
        if not self.parameters:
            return self
        return drawn(
            lambda: rng.standard_normal(len(self.parameters)),
            lambda z: self.with_parameters(values_at(self.parameters, z)),
        )[1]

    def narrowed(self, scale: float) -> Nominal:
        """The model with deviations of draws scaled by `scale`; the model itself if it cannot scale them."""
        return self


def drawn(draw: Callable[[], Array], at: Callable[[Array], Nominal]) -> tuple[Array, Nominal]:
    """Coordinates of parameters, and the model at them: the first draw that is physically feasible.

    ValueError if none of many draws is.
    """
    for _ in range(MOST_DRAWS):
        z = draw()
        model = at(z)
        if (model.slack >= 0.0).all():
            return z, model
    raise ValueError(f"uncertainty: none of {MOST_DRAWS} drawn sets of parameters gives a possible robot")


class Identification(ABC):
    """Identification of the nominal model's parameters, before a bias is learned from the residuals.

    The same data give the same model, since a replayed trial fits again: random numbers need a fixed seed.
    """

    @abstractmethod
    def fit(self, nominal: Nominal, rollouts: Sequence[Rollout]) -> Nominal:
        """The model at the posterior mode of its parameters; its `draw` samples from the posterior.

        `nominal.parameters` hold the prior. The rollouts are all hardware experiments of a trial, including
        failed ones. Without rollouts or parameters, the result is the nominal model itself, or that model
        with the motors and sensors whose parameters are uncertain.
        """


class Samples(ABC):
    """The choice of training data (Section IV-C)."""

    @abstractmethod
    def select(self, rollouts: Sequence[Rollout], nominal: Nominal) -> Selection:
        """Select transitions worth learning from, with their residuals against the nominal model (Eq. 6)."""


class Bias(ABC):
    """A learner of the dynamics bias; the same data give the same bias, as for an `Identification`."""

    @abstractmethod
    def fit(self, transitions: Transitions) -> FittedBias:
        """Learn from the data, which are read-only; without data the bias is zero everywhere."""

    def learn(self, transitions: Transitions, rollouts: Sequence[Rollout], nominal: Nominal) -> FittedBias:
        """Learn from the data, or from their source: the rollouts and the (identified) nominal model."""
        return self.fit(transitions)


class FittedBias(ABC):
    """The learned dynamics bias g_D."""

    kernel: Kernel | None = None
    diagnostics: Mapping[str, float] = MappingProxyType({})  #: of the learner's fit

    @abstractmethod
    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n) and variance (k, n) of the residual at raw inputs (k, n+m) (Eq. 4, 5)."""

    @abstractmethod
    def correction(self, x: Array, u: Array) -> Array:
        """The correction of the nominal step at x (..., n), u (..., m): the last term (..., n) of Eq. 7."""

    def draw(self, rng: np.random.Generator) -> FittedBias:
        """A bias drawn from the posterior given the data; this bias if it has no posterior."""
        return self


@dataclass(frozen=True, eq=False)
class Model:
    """The corrected simulation model of Eq. 7, with the task and the policy that close the loop."""

    task: Task
    policy: Policy
    nominal: Nominal
    bias: FittedBias
