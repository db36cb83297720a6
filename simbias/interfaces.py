"""Every contract of simbias, on one page.

n states x, m inputs u, q outputs z, p policy parameters theta; T frames of `time_step` seconds.
Units are the task's. Components are built from YAML: the keys of `conf/<group>/<name>.yaml` are the
constructor's arguments, checked against its annotations; an argument named `task` receives the task.
State is passed, never hidden; randomness comes only from a passed NumPy generator.

A component may offer a compiled `kernel` (`simbias.simulation.kernels` has the signature of each
role). When all parts of a closed loop do, whole rollouts run without Python; otherwise its methods are
called frame by frame, with the same results.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

import numpy as np

from simbias.records import Array, Iteration, Optimum, Rollout, Selection, Transitions
from simbias.search import Evaluations

if TYPE_CHECKING:
    from pandas import DataFrame

    from simbias.pictures.sweep.batches import Batch, Outcomes
    from simbias.pictures.sweep.picture import Picture
    from simbias.pictures.sweep.swept import SweptTrials
    from simbias.simulation.closed_loop import Model
    from simbias.study import Study
    from simbias.sweep.grid import Sweep, Trial
    from simbias.tracking.trials import RecordedTrial
    from simbias.worker import TrialRecord

T = TypeVar("T")
R = TypeVar("R")


class HardwareError(RuntimeError):
    """The hardware could not carry out an experiment; a robot that falls is no error but a failure."""


class WorkerLostError(RuntimeError):
    """A worker died with its trial, again and again."""


class SlowWarning(UserWarning):
    """What was asked for works, but slowly; the message says how slowly, and what would be faster."""


class Kernel(NamedTuple):
    """A compiled function of one role and the arrays that it reads besides its role's arguments."""

    function: Any
    parameters: Any


class Quantity(NamedTuple):
    """A component of a state, input or output vector."""

    name: str
    unit: str


class Criterion(NamedTuple):
    """A failure criterion of Section IV-C: x fails where its measure is above the limit."""

    name: str
    words: str
    limit: float
    unit: str


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
        """Measures (c,) of the state x (n,), to be held against the limits of the criteria."""

    @abstractmethod
    def output(self, x: Array) -> Array:
        """Outputs z (q,) of the state x (n,), from which a policy computes its input."""

    def violated(self, x: Array) -> int | None:
        """Index of the first criterion that x (n,) violates, or None; what is not a number violates."""
        for index, (value, criterion) in enumerate(zip(self.measure(x), self.criteria, strict=True)):
            if not value <= criterion.limit:
                return index
        return None

    def draw_start(self, rng: np.random.Generator) -> Array:
        """A random start (n,): start_mean + N(0, start_deviation^2) (Section VI-A)."""
        return self.start_mean + self.start_deviation * rng.standard_normal(len(self.states))


class Nominal(ABC):
    """The simulation model f' (Section IV-A)."""

    kernel: Kernel | None = None

    @abstractmethod
    def step(self, x: Array, u: Array) -> Array:
        """x_next (n,) = x + f'(x, u), one time step after x (n,) under u (m,) (Eq. 1)."""

    def draw(self, rng: np.random.Generator) -> Nominal:
        """A model that might be the right one, as far as its parameters are known; this one if they are."""
        return self


class Policy(ABC):
    """The feedback law whose parameters theta are searched."""

    n_parameters: int
    bounds: tuple[Array, Array]  # lower (p,), upper (p,)
    kernel: Callable[[Array], Kernel] | None = None  # of theta (p,)

    @abstractmethod
    def act(self, theta: Array, x: Array) -> Array:
        """Input u (m,) at the (measured) state x (n,), within the task's limits."""

    @abstractmethod
    def outputs(self, x: Array) -> Array:
        """What the policy feeds back: z (q,) at the state x (n,)."""


class FittedBias(ABC):
    """The learned dynamics bias g_D."""

    kernel: Kernel | None = None
    diagnostics: Mapping[str, float] = MappingProxyType({})  # what the learner says of its fit

    @abstractmethod
    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n) and variance (k, n) of the residual at raw inputs (k, n+m) (Eq. 4, 5)."""

    @abstractmethod
    def correction(self, x: Array, u: Array) -> Array:
        """What is added to the nominal step at x (n,), u (m,): the last term (n,) of Eq. 7."""

    def draw(self, rng: np.random.Generator) -> FittedBias:
        """A bias that might be the right one, as far as the data tells; this one if it does not say."""
        return self


class Bias(ABC):
    """A learner of the dynamics bias."""

    @abstractmethod
    def fit(self, transitions: Transitions) -> FittedBias:
        """Learn from the data; without data the bias is zero everywhere."""


class Simulator(Protocol):
    """The closed loop of policy, nominal model and bias (Eq. 7, 9), with or without noise."""

    def rollout(self, theta: Array, start: Array) -> Rollout:
        """Run theta (p,) from start (n,) to failure or horizon; the rollout's cost is not set."""

    def rollouts(self, thetas: Array, starts: Array) -> Sequence[Rollout]:
        """Run each theta of (k, p) from its start of (k, n); much faster together than one by one."""


class Objective(Protocol):
    """What a policy search minimises; deterministic. A plain function will do, `together` is faster."""

    def __call__(self, theta: Array) -> float:
        """Cost of theta (p,)."""

    def together(self, thetas: Array) -> Array:
        """Costs (k,) of thetas (k, p)."""


class Hardware(ABC):
    """The expensive system."""

    @abstractmethod
    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """One experiment with theta (p,) from start (n,); its cost is not set.

        Raises
        ------
        HardwareError
            If the experiment could not be carried out.
        """


class Samples(ABC):
    """The choice of training data (Section IV-C)."""

    @abstractmethod
    def select(self, rollouts: Sequence[Rollout], nominal: Nominal) -> Selection:
        """Transitions worth learning from, with their residuals against the nominal model (Eq. 6)."""


class Cost(ABC):
    """What a rollout costs, and above which cost a policy has failed."""

    max_cost: float  # Z_max

    @abstractmethod
    def of(self, rollout: Rollout) -> float:
        """Z of a rollout: finite, and above max_cost where the rollout failed."""


class Evaluation(ABC):
    """How the cost of a policy is predicted in simulation."""

    @abstractmethod
    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Objective:
        """The predicted cost as a function of theta; what it samples is drawn once, from rng."""


class Optimizer(ABC):
    """A minimiser over a box."""

    max_evaluations: int  # N_in
    relative_tolerance: float  # epsilon

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

        Only a search whose best cost is below `satisfactory` may end before its last evaluation because it
        converges: among policies that fail, costs of Eq. 8 lie on plateaus that look like convergence.
        The candidates (p,) are evaluated first, and a search that starts from a point starts from the best.

        Raises
        ------
        ValueError
            If the box is empty or not finite, a cost is not finite, or the algorithm cannot take so many
            parameters.
        """
        evaluations = Evaluations(
            objective, lower, upper, self.max_evaluations, self.relative_tolerance, satisfactory
        )
        evaluations.try_first(candidates)
        stopped_by = evaluations.run(lambda running: self.search(running, rng))
        return evaluations.optimum(stopped_by)


class Observer(Protocol):
    """Hears of what happens inside an iteration, while it happens."""

    def searching(self, evaluations: int, best_cost: float) -> None:
        """A policy search has simulated so many policies, a few in vain if it looks ahead."""

    def experimented(self, iteration: int, experiment: int, theta: Array, rollout: Rollout) -> None:
        """A hardware experiment has ended; called before its data is used."""


class Method(ABC):
    """An algorithm that learns and optimises."""

    max_iterations: int  # N_out

    @abstractmethod
    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every iteration as it ends."""


class Tracking(ABC):
    """A store for the records of a trial."""

    pictures: bool = False  # whether it keeps pictures of trials

    @abstractmethod
    def open(self, study: Study) -> TrackedTrial:
        """Begin the record of a trial."""

    @abstractmethod
    def open_sweep(self, sweep: Sweep, again: str) -> TrackedSweep:
        """Begin the record of a sweep, or go on with it; `again` is the command that does so."""

    @abstractmethod
    def finished(self, sweep: Sweep) -> DataFrame:
        """What is kept of a sweep's finished trials, see `simbias.tracking.results`; changes nothing."""


class TrackedTrial(ABC):
    """The open record of one trial; every call returns after its data is safe."""

    where: str | None  # one line that tells a person how to look at it

    @abstractmethod
    def experimented(self, iteration: int, experiment: int, theta: Array, rollout: Rollout) -> None:
        """Keep a hardware experiment."""

    @abstractmethod
    def log(self, iteration: Iteration) -> None:
        """Keep an iteration."""

    @abstractmethod
    def illustrate(self, pictures: Mapping[str, bytes]) -> None:
        """Keep pictures of the trial, files by name; it may have been closed."""

    @abstractmethod
    def close(self, error: BaseException | None = None) -> None:
        """End the record; the error says why it ended early."""


class TrackedSweep(ABC):
    """The open record of a sweep."""

    where: str | None  # one line that tells a person how to look at it
    keeps: bool  # whether a later process finds the finished trials
    finished: frozenset[str]  # hashes of the trials that were finished before

    @abstractmethod
    def keep(self, trial: Trial, study: Study, record: TrialRecord) -> None:
        """Keep all of a trial; it counts as finished once everything is written, unless it raised."""

    @abstractmethod
    def results(self) -> DataFrame:
        """The trials that are finished or raised, as `simbias.tracking.results` describes them."""

    @abstractmethod
    def load(self, run_id: str) -> RecordedTrial:
        """A trial that was kept, in full."""

    @abstractmethod
    def keep_outcomes(self, batch: str, outcomes: Outcomes) -> None:
        """Keep the outcomes of a batch of experiments, by its hash."""

    @abstractmethod
    def outcomes(self, batches: Sequence[str]) -> dict[str, Outcomes]:
        """Those outcomes that are kept, by the hashes of their batches."""

    @abstractmethod
    def publish(self, name: str, caption: str, files: Sequence[Path]) -> None:
        """Keep a figure; its files replace those of the same names."""

    @abstractmethod
    def close(self, error: BaseException | None = None) -> None:
        """End the record with the table of what is there; the error says why it ended early."""


class SweepFigure(ABC):
    """A figure of a sweep, drawn once all trials have ended."""

    reads_trials = True  # in full, from the store; else only their table

    def experiments(self, trials: SweptTrials) -> Sequence[Batch]:
        """Hardware experiments that it needs besides those of the trials; none, if not said otherwise."""
        return ()

    @abstractmethod
    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        """The picture, from the trials and the outcomes of the experiments.

        Raises
        ------
        FigureError
            If it cannot be drawn from what there is.
        """


class Engine(ABC):
    """Where the trials of a sweep run."""

    @abstractmethod
    def run(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Iterator[tuple[int, R | WorkerLostError]]:
        """Yield (index of a task, function(task)) as tasks end, in any order, every task once.

        `function` is one of a module's, raises nothing and changes nothing, so a task whose worker died runs
        again; one whose workers die each time yields a WorkerLostError. Tasks are plain containers.
        Closing the iterator stops the workers.
        """
