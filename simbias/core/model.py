"""The simulation model of a robot, its parameters, the data, and the bias learned from them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from simbias.core.kernel import Kernel
from simbias.core.parameters import Estimate, Parameter, values_at
from simbias.core.policy import Policy
from simbias.core.records import Array, Rollout, Selection, Transitions
from simbias.core.robot import Task

MOST_DRAWS = 1000  # of parameters, until a robot may have them


class Nominal(ABC):
    """The simulation model f' (Section IV-A).

    A model of what the state does not show, as an actuator's lag or a delay, keeps it in its own state,
    which is zero at the start of a rollout (`simbias.simulation.actuator`), not of its parts
    (`Rollout.with_history`). Its bias is a function of the commanded input (Eq. 2), or of the one that acts,
    where the model state keeps that.
    """

    kernel: Kernel | None = None
    parameters: tuple[Parameter, ...] = ()  # those that are not known exactly
    state_size: int = 0  # s, of the model state
    acting: tuple[int, ...] = ()  # rows of the model state that keep the input that acted; none: see `acted`
    estimates: Sequence[Estimate] = ()  # what has been identified
    diagnostics: Mapping[str, float] = MappingProxyType({})  # what the identification says of its fit

    @abstractmethod
    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n) = x + f'(x, u), one time step after x (..., n) under u (..., m) (Eq. 1).

        Of a model with a state of its own: as if u had acted for long.
        """

    def advance(self, x: Array, u: Array, model_state: Array) -> tuple[Array, Array]:
        """x_next (..., n), and the model state (..., s) for the next frame; for models that have one."""
        return self.step(x, u), model_state

    def acted(self, u: Array, model_state: Array) -> Array:
        """Input (..., m) that a bias is a function of: u, or what acted in the frame that left this state."""
        return model_state[..., self.acting] if self.acting else u

    def model_states(self, states: Array, inputs: Array) -> Array:
        """Model states (k, s) in each frame of a record: of its states (k, n) and inputs (k, m)."""
        kept, model_state = np.zeros((len(inputs), self.state_size)), np.zeros(self.state_size)
        for t in range(len(inputs) if self.state_size else 0):
            kept[t] = model_state
            _, model_state = self.advance(states[t], inputs[t], model_state)
        return kept

    def along(self, states: Array, inputs: Array) -> Array:
        """x_next (k, n) predicted from each state (k, n) of a recorded rollout under its inputs (k, m).

        What the states do not show is simulated from the inputs that came before.
        """
        if not self.state_size:
            return self.step(states, inputs)
        return self.advance(states, inputs, self.model_states(states, inputs))[0]

    def acted_along(self, states: Array, inputs: Array) -> Array:
        """Inputs (k, m) that a bias is a function of, along a recorded rollout: see `along`, `acted`."""
        if not self.acting:
            return inputs
        return self.acted(inputs, self.advance(states, inputs, self.model_states(states, inputs))[1])

    def with_parameters(self, values: Array) -> Nominal:
        """The model with other values (k,) of its `parameters`, in their units.

        Its own `parameters` are the same priors, or have these values.
        """
        raise NotImplementedError(f"{type(self).__name__} has parameters, but no `with_parameters`")

    def oddity(self) -> tuple[str, str] | None:
        """An oddity of the identified model, in few words and in a sentence; None if there is none."""
        return None

    @property
    def slack(self) -> Array:
        """How far (c,) each condition on its parameters is from being broken; below 0, no robot has them."""
        return np.empty(0)

    def without_dry_friction(self) -> Nominal:
        """The model as it is while its joints slide: at rest, dry friction is steeper than any damping."""
        return self

    def without_input_limits(self) -> Nominal:
        """The model that takes any input: motors before it may give more than is commanded."""
        return self

    def draw(self, rng: np.random.Generator) -> Nominal:
        """A model that might be the right one, as far as its parameters are known; this one if they are."""
        if not self.parameters:
            return self
        return drawn(
            lambda: rng.standard_normal(len(self.parameters)),
            lambda z: self.with_parameters(values_at(self.parameters, z)),
        )[1]

    def narrowed(self, scale: float) -> Nominal:
        """The model, its draws deviating `scale` times as much; itself if it cannot narrow them."""
        return self


def drawn(draw: Callable[[], Array], at: Callable[[Array], Nominal]) -> tuple[Array, Nominal]:
    """Coordinates of parameters, and the model at them: the first that are drawn of a robot that may be.

    ValueError if none of many is.
    """
    for _ in range(MOST_DRAWS):
        z = draw()
        model = at(z)
        if (model.slack >= 0.0).all():
            return z, model
    raise ValueError(f"uncertainty: no robot has any of {MOST_DRAWS} sets of parameters that were drawn")


class Identification(ABC):
    """Identification of the nominal model's parameters, before a bias is learned of the residuals."""

    @abstractmethod
    def fit(self, nominal: Nominal, rollouts: Sequence[Rollout]) -> Nominal:
        """The model at the parameters' most probable values, whose `draw` draws from their posterior.

        `nominal.parameters` are the prior, the rollouts all hardware experiments of a trial, also those that
        failed. Without rollouts or parameters it is the nominal model itself, or that model with the motors
        and sensors whose parameters are uncertain.
        """


class Samples(ABC):
    """The choice of training data (Section IV-C)."""

    @abstractmethod
    def select(self, rollouts: Sequence[Rollout], nominal: Nominal) -> Selection:
        """Transitions worth learning from, with their residuals against the nominal model (Eq. 6)."""


class Bias(ABC):
    """A learner of the dynamics bias."""

    @abstractmethod
    def fit(self, transitions: Transitions) -> FittedBias:
        """Learn from the data, which are read-only; without data the bias is zero everywhere."""

    def learn(self, transitions: Transitions, rollouts: Sequence[Rollout], nominal: Nominal) -> FittedBias:
        """Learn from the data, or from the rollouts and the (identified) nominal model that it comes from."""
        return self.fit(transitions)


class FittedBias(ABC):
    """The learned dynamics bias g_D."""

    kernel: Kernel | None = None
    diagnostics: Mapping[str, float] = MappingProxyType({})  # what the learner says of its fit

    @abstractmethod
    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n) and variance (k, n) of the residual at raw inputs (k, n+m) (Eq. 4, 5)."""

    @abstractmethod
    def correction(self, x: Array, u: Array) -> Array:
        """The correction of the nominal step at x (..., n), u (..., m): the last term (..., n) of Eq. 7."""

    def draw(self, rng: np.random.Generator) -> FittedBias:
        """A bias that might be the right one, as far as the data tells; this one if it does not say."""
        return self


@dataclass(frozen=True, eq=False)
class Model:
    """The corrected simulation model of Eq. 7, and the task and policy that close its loop."""

    task: Task
    policy: Policy
    nominal: Nominal
    bias: FittedBias
