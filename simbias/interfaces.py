"""The contract of every component: what the author of one reads.

n states x, m inputs u, q outputs z, p policy parameters theta, s numbers of a policy's memory; T frames of
`time_step` seconds. Units are the task's. Components are built from YAML: the keys of
`conf/<group>/<name>.yaml` are the constructor's arguments, checked against its annotations; an argument named
`task` receives the task. State is passed, never hidden; randomness comes only from a passed NumPy generator.

Where a shape begins with `...`, any leading axes may stand, as in NumPy's own functions: a policy search
simulates all its candidates together. A component may offer a compiled `kernel` besides
(`simbias.simulation.kernels`). When all parts of a closed loop do, rollouts run without Python, with the same
numbers. The contract of a method is beside the study that it runs: `simbias.study`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np

from simbias.parameters import Estimate, Parameter, values_at
from simbias.records import Array, Indices, Optimum, Rollout, Selection, Transitions
from simbias.search import Evaluations

NOT_A_NUMBER = "not_a_number"  # the failure of a state that violates no criterion


class HardwareError(RuntimeError):
    """The hardware could not carry out an experiment; a robot that falls is no error but a failure."""


class Waiting(Exception):  # noqa: N818 (no error: a lab takes its time)
    """The result of an experiment is not there yet; the message says in one sentence what to do meanwhile."""


class SlowWarning(UserWarning):
    """What was asked for works, but slowly; the message says how slowly, and what would be faster."""


class Kernel(NamedTuple):
    """What a component offers to the compiled closed loop: see `simbias.simulation.kernels`."""

    function: Callable
    parameters: Any  # an array; of a bias that works on all lanes, a tuple of arrays


class Quantity(NamedTuple):
    """A component of a state, input or output vector."""

    name: str
    unit: str
    kind: str = ""  # what it shares with others, so that noise can be declared of all at once: "angle"

    @property
    def names(self) -> tuple[str, ...]:
        """What it can be called by, its own name first."""
        return (self.name, self.kind) if self.kind else (self.name,)


class Criterion(NamedTuple):
    """A failure criterion of Section IV-C: x fails where its measure is above the limit."""

    name: str
    words: str
    limit: float
    unit: str
    bounds: Mapping[str, float] = MappingProxyType({})  # state -> |state| that it allows, whatever the others


def failure_name(criteria: Sequence[Criterion], index: int) -> str:
    """The name of a violated criterion, or of a state that is no number and violates none."""
    return criteria[index].name if index < len(criteria) else NOT_A_NUMBER


class Task(ABC):
    """What is to be done: quantities, time, limits, starts and failure; no dynamics."""

    states: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    criteria: tuple[Criterion, ...]
    time_step: float  # s
    horizon: int  # T, frames
    input_limit: Array  # (m,) |u| <= input_limit
    start_mean: Array  # (n,)
    start_deviation: Array  # (n,)
    measure_kernel: Kernel | None = None
    output_kernel: Kernel | None = None

    @abstractmethod
    def measure(self, x: Array) -> Array:
        """Measures (..., c) of states x (..., n), to be held against the limits of the criteria."""

    @abstractmethod
    def output(self, x: Array) -> Array:
        """Outputs z (..., q) of states x (..., n), from which a policy computes its input."""

    def violated(self, x: Array) -> Indices:
        """Index (...) of the first criterion that each state x (..., n) violates, -1 where it violates none.

        What is not a number violates: it has the index after all criteria where it violates none of them.
        """
        within = self.measure(x) <= np.array([criterion.limit for criterion in self.criteria])
        within = np.concatenate([within, np.isfinite(x).all(axis=-1, keepdims=True)], axis=-1)
        return np.where(within.all(axis=-1), -1, np.argmin(within, axis=-1))

    def failure(self, x: Array) -> str | None:
        """Name of the first criterion that the state x (n,) violates, or None."""
        index = int(self.violated(x))
        return None if index < 0 else failure_name(self.criteria, index)

    def words(self, failure: str) -> str:
        """A failure in words: those of its criterion, or the name that a hardware gave it."""
        words = {criterion.name: criterion.words for criterion in self.criteria}
        return words.get(failure, failure.replace("_", " "))

    def with_horizon(self, horizon: int) -> Task:
        """The task, which now takes so many frames."""
        longer = copy(self)
        longer.horizon = horizon
        return longer

    def frames(self, seconds: float) -> int:
        """How many frames so many seconds take, at least one."""
        return max(1, round(seconds / self.time_step))

    def draw_start(self, rng: np.random.Generator) -> Array:
        """A random start (n,): start_mean + N(0, start_deviation^2) (Section VI-A)."""
        return self.start_mean + self.start_deviation * rng.standard_normal(len(self.states))


class Nominal(ABC):
    """The simulation model f' (Section IV-A).

    A model of what the state does not show, as an actuator's lag or a delay, keeps it in its memory, which is
    zero at the start (`simbias.simulation.actuator`).
    """

    kernel: Kernel | None = None
    batched: bool = False  # whether an engine steps many states at once, about as fast as compiled code
    parameters: tuple[Parameter, ...] = ()  # those that are not known exactly
    memory_size: int = 0  # s
    estimates: Sequence[Estimate] = ()  # what has been identified
    diagnostics: Mapping[str, float] = MappingProxyType({})  # what the identification says of its fit

    @abstractmethod
    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n) = x + f'(x, u), one time step after x (..., n) under u (..., m) (Eq. 1).

        Of a model with memory: as if u had acted for long.
        """

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        """x_next (..., n), and the memory (..., s) for the next frame; only models with memory need it."""
        return self.step(x, u), memory

    def memories(self, states: Array, inputs: Array) -> Array:
        """Memory (k, s) in each frame of a record, from its start on, of states (k, n) and inputs (k, m)."""
        kept, memory = np.zeros((len(inputs), self.memory_size)), np.zeros(self.memory_size)
        for t in range(len(inputs) if self.memory_size else 0):
            kept[t] = memory
            _, memory = self.advance(states[t], inputs[t], memory)
        return kept

    def along(self, states: Array, inputs: Array) -> Array:
        """x_next (k, n) predicted from each state (k, n) of a recorded rollout under its inputs (k, m).

        What the states do not show is simulated from the inputs that came before.
        """
        if not self.memory_size:
            return self.step(states, inputs)
        return self.advance(states, inputs, self.memories(states, inputs))[0]

    def step_in_worlds(self, models: Sequence[Nominal], x: Array, u: Array, worlds: Indices) -> Array:
        """x_next (k, n), each row after x (k, n) under u (k, m) with the model of its world of (k,).

        Only batched models need it; all of them are of one class.
        """
        raise NotImplementedError(f"{type(self).__name__} is batched, but has no `step_in_worlds`")

    def with_parameters(self, values: Array) -> Nominal:
        """The model with other values (k,) of its `parameters`, in their units."""
        raise NotImplementedError(f"{type(self).__name__} has parameters, but no `with_parameters`")

    def draw(self, rng: np.random.Generator) -> Nominal:
        """A model that might be the right one, as far as its parameters are known; this one if they are."""
        if not self.parameters:
            return self
        return self.with_parameters(values_at(self.parameters, rng.standard_normal(len(self.parameters))))


class Law(NamedTuple):
    """A policy in words and numbers, as an order to a lab says it."""

    words: str  # as u = H z
    numbers: Mapping[str, Array]  # what the words name, in the task's units


class Policy(ABC):
    """The feedback law whose parameters theta are searched.

    A law with a filter, an integral or a delay keeps what it needs in its memory, which is zero at the start.
    """

    n_parameters: int
    bounds: tuple[Array, Array]  # lower (p,), upper (p,)
    memory_size: int = 0  # s
    kernel: Callable[[Array], Kernel] | None = None  # of thetas (k, p): its parameters (k, r) are theirs

    @abstractmethod
    def act(self, theta: Array, x: Array, t: float, memory: Array) -> tuple[Array, Array]:
        """Inputs u (..., m) within the task's limits, and the memory (..., s) for the next frame.

        theta (..., p), (measured) states x (..., n), time t in s since the start, memory (..., s). Most laws
        ignore the time, and return the memory as it came.
        """

    @abstractmethod
    def outputs(self, x: Array) -> Array:
        """What the policy feeds back: z (..., q) at states x (..., n)."""

    def law(self, theta: Array) -> Law:
        """The policy theta (p,) for people and programs without simbias, as far as it can be said."""
        return Law(f"u = {type(self).__name__}.act(theta, x, t, memory)", {"theta": theta})

    def controller(self, theta: Array, time_step: float) -> Controller:
        """The policy theta (p,) as a robot's control loop runs it: once a frame of `time_step` s."""
        return Controller(self, theta, time_step)


class Controller:
    """A policy in a control loop: u (m,) = controller(x), called once a frame; it keeps time and memory."""

    def __init__(self, policy: Policy, theta: Array, time_step: float) -> None:
        self._policy = policy
        self._theta = theta
        self._time_step = time_step
        self._frame = 0
        self._memory = np.zeros(policy.memory_size)

    def __call__(self, x: Array) -> Array:
        """Input u (m,) at the (measured) state x (n,) of the next frame."""
        time = self._frame * self._time_step
        u, self._memory = self._policy.act(self._theta, x, time, self._memory)
        self._frame += 1
        return u


class FittedBias(ABC):
    """The learned dynamics bias g_D."""

    kernel: Kernel | None = None
    diagnostics: Mapping[str, float] = MappingProxyType({})  # what the learner says of its fit

    @abstractmethod
    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n) and variance (k, n) of the residual at raw inputs (k, n+m) (Eq. 4, 5)."""

    @abstractmethod
    def correction(self, x: Array, u: Array) -> Array:
        """What is added to the nominal step at x (..., n), u (..., m): the last term (..., n) of Eq. 7."""

    def draw(self, rng: np.random.Generator) -> FittedBias:
        """A bias that might be the right one, as far as the data tells; this one if it does not say."""
        return self


class Bias(ABC):
    """A learner of the dynamics bias."""

    @abstractmethod
    def fit(self, transitions: Transitions) -> FittedBias:
        """Learn from the data; without data the bias is zero everywhere."""

    def learn(self, transitions: Transitions, rollouts: Sequence[Rollout], nominal: Nominal) -> FittedBias:
        """Learn from the data, or from the rollouts and the (identified) nominal model that it comes from."""
        return self.fit(transitions)


@dataclass(frozen=True, eq=False)
class Model:
    """The corrected simulation model of Eq. 7, and the task and policy that close its loop."""

    task: Task
    policy: Policy
    nominal: Nominal
    bias: FittedBias


class Simulator(Protocol):
    """The closed loop of policy, nominal model and bias (Eq. 7, 9), with or without noise."""

    def rollout(self, theta: Array, start: Array) -> Rollout:
        """Run theta (p,) from start (n,) to failure or horizon; the rollout's cost is not set."""

    def rollouts(self, thetas: Array, starts: Array) -> Sequence[Rollout]:
        """Run each theta of (k, p) from its start of (k, n); much faster together than one by one."""

    def costs(self, cost: Cost, thetas: Array, starts: Array) -> tuple[Array, Indices]:
        """Costs (k,) of these rollouts, and how many frames (k,) they have; faster than the rollouts."""


class Objective(Protocol):
    """What a policy search minimises; deterministic. A plain function will do, `together` is faster."""

    steps: int  # simulated so far, for searches that are limited by them

    def __call__(self, theta: Array) -> float:
        """Cost of theta (p,)."""

    def together(self, thetas: Array) -> Array:
        """Costs (k,) of thetas (k, p)."""


class Hardware(ABC):
    """The expensive system."""

    sets_start: bool = True  # whether an experiment begins where it is asked to; else where the robot stands

    @abstractmethod
    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """One experiment with theta (p,); cost and parameters of the rollout are not set.

        It begins at the start (n,), or as near to it as the robot can: the rollout's first state says where.
        `policy.controller(theta, time_step)` computes the input of each frame. Whatever else than the errors
        below it raises, and whatever it returns that is no rollout of the task, ends the trial in one line,
        and what it returned is kept; the same command goes on once it is mended (`simbias.experiments`).

        Raises
        ------
        HardwareError
            If the experiment could not be carried out.
        Waiting
            If its result is not there yet. The same experiment is asked for again at the next start.
        """

    def stop(self) -> None:  # noqa: B027  (few need it)
        """Bring the system to rest: an experiment took too long, was interrupted or went beyond a limit.

        With `experiment_timeout` it is called from another thread while `run` still runs; `run` should end
        soon afterwards, what it returns or raises is of no interest. Beyond a limit of `hardware.safety`,
        `run` has ended by what the controller raised. By default nothing happens.
        """


class Identification(ABC):
    """What is learned of the nominal model's parameters, before a bias is learned of what they leave."""

    @abstractmethod
    def fit(self, nominal: Nominal, rollouts: Sequence[Rollout]) -> Nominal:
        """The model at the parameters' most probable values, whose `draw` draws from their posterior.

        `nominal.parameters` are the prior, the rollouts all hardware experiments of a trial, also those that
        failed. Without rollouts or parameters it is the nominal model itself.
        """


class Samples(ABC):
    """The choice of training data (Section IV-C)."""

    @abstractmethod
    def select(self, rollouts: Sequence[Rollout], nominal: Nominal) -> Selection:
        """Transitions worth learning from, with their residuals against the nominal model (Eq. 6)."""


class Cost(ABC):
    """What a rollout costs, and above which cost a policy has failed."""

    max_cost: float  # Z_max
    kernel: Kernel | None = None
    totals: int = 0  # s, how many numbers the kernel sums up

    @abstractmethod
    def of(self, rollout: Rollout) -> float:
        """Z of a rollout: finite."""

    def of_totals(self, totals: Array, lost: Indices) -> Array:
        """Z (k,) of rollouts that the kernel summed up as totals (k, s), of frames (k,) lost by failure."""
        raise NotImplementedError(f"{type(self).__name__} has a kernel, but no `of_totals`")

    def with_horizon(self, horizon: int) -> Cost:
        """The cost of rollouts that may take so many frames; only what simulates for longer needs it."""
        raise NotImplementedError(f"{type(self).__name__} has no `with_horizon`")

    def passes(self, rollout: Rollout) -> bool:
        """Whether a rollout, its cost set, is a success: no failure, and Z < Z_max."""
        return rollout.failed_at is None and rollout.cost < self.max_cost


class Evaluation(ABC):
    """How the cost of a policy is predicted in simulation."""

    noisy_rollouts: int = 0  # of each policy, whose noise is kept as long as a search goes on
    horizon: int | None = None  # frames of its rollouts; None is the task's

    @abstractmethod
    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Objective:
        """The predicted cost as a function of theta; what it samples is drawn once, from rng."""


class Optimizer(ABC):
    """A minimiser over a box."""

    max_evaluations: int  # N_in
    relative_tolerance: float  # epsilon
    max_steps: int | None = None  # of simulation, after which a search ends
    max_seconds: float | None = None  # likewise

    @abstractmethod
    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Evaluate points of a box until it is no longer worth it; why, in words.

        Raises
        ------
        SearchEnded
            From `evaluations`, once they are used up or their costs have converged.
        """

    def minimize(
        self,
        objective: Callable[[Array], float],
        lower: Array,
        upper: Array,
        rng: np.random.Generator,
        satisfactory: float = np.inf,
        candidates: Sequence[Array] = (),
    ) -> Optimum:
        """Best point found in lower (p,) <= theta <= upper (p,); the objective's exceptions pass through.

        It ends at the latest after `max_evaluations`, or once `max_steps` or `max_seconds` are used up. Only
        a search whose best cost is below `satisfactory` may end earlier because it converges: among
        policies that fail, costs of Eq. 8 lie on plateaus that look like convergence.
        The candidates (p,) are evaluated first, and a search that starts from a point starts from the best.

        Raises
        ------
        ValueError
            If the box is empty or not finite, a cost is not finite, or the algorithm cannot take so many
            parameters.
        """
        evaluations = Evaluations(
            objective,
            lower,
            upper,
            self.max_evaluations,
            self.relative_tolerance,
            satisfactory,
            self.max_steps,
            self.max_seconds,
        )
        evaluations.try_first(candidates)
        stopped_by = evaluations.run(lambda running: self.search(running, rng))
        return evaluations.optimum(stopped_by)
