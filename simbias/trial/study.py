"""A study: the composed components of a trial."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NoReturn, Protocol

import numpy as np
from pydantic import TypeAdapter

from simbias.core import (
    Bias,
    Cost,
    Evaluation,
    FittedBias,
    Hardware,
    Identification,
    Model,
    Nominal,
    Optimizer,
    Policy,
    Samples,
    Simulator,
    StudyWarning,
    Task,
)
from simbias.core.error_origin import is_own
from simbias.core.errors import ConfigError
from simbias.core.records import Array, Disturbance, Iteration, Rollout, Selection, Transitions
from simbias.lab.checked_hardware import DEFAULT_CONDITIONS, CheckedHardware, ExperimentConditions
from simbias.lab.requests.request import ExperimentRequest
from simbias.policy.trajectory import Trajectory
from simbias.simulation.closed_loop import simulator
from simbias.simulation.noise import QUIET, Noise, Variances
from simbias.simulation.numpy_loop import shaped
from simbias.trial.ask_tell import AskTell
from simbias.trial.budget import NO_LIMITS, Budget, BudgetSpent, Spending
from simbias.trial.checked_bias import CheckedBias
from simbias.trial.method import Method
from simbias.trial.observer import Observer
from simbias.trial.policy_test import NO_TEST, PolicyTest
from simbias.trial.replay import Record, ReplayedOptimizer

BESIDE = ("composition", "hardware_of", "nominal_of", "conditions", "spending", "composed")
OF_HARDWARE = "policy.noise='${noise_of_hardware:}' takes the hardware's"
WITH_NOISE = ("kalman", "disturbance")  # observers that need the variances of the measurements


class Origin(Protocol):
    """The config that a study was built from: plain containers with resolved interpolations."""

    @property
    def config(self) -> Mapping[str, Any]:
        """The config of every group."""

    @property
    def choices(self) -> Mapping[str, str]:
        """The chosen option of every config group."""

    @property
    def code(self) -> Mapping[str, str]:
        """Digests, by name, of the user's modules that define components."""

    @property
    def from_environment(self) -> tuple[str, ...]:
        """Keys of the config whose values come from environment variables."""

    @property
    def identity_fields(self) -> Mapping[str, Any]:
        """The config as far as it affects a trial's result."""

    @property
    def hash(self) -> str:
        """The trial's identity, a hash of everything that affects its result."""


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """The components of a trial."""

    task: Task
    nominal: Nominal
    hardware: Hardware
    policy: Policy
    identification: Identification
    samples: Samples
    bias: Bias
    cost: Cost
    evaluation: Evaluation
    optimizer: Optimizer
    method: Method
    seed: int
    composition: Origin  #: what the components were built from
    hardware_of: Callable[[Task], Hardware]  #: reconstructs the hardware for another horizon
    nominal_of: Callable[[Task], Nominal]  #: reconstructs the nominal model for another time step
    conditions: ExperimentConditions = DEFAULT_CONDITIONS  #: of hardware experiments
    policy_test: PolicyTest = NO_TEST
    budget: Budget = NO_LIMITS
    spending: Spending = field(default_factory=Spending)  #: of the budget in a running trial
    composed: list[Any] = field(default_factory=list)  #: the components that `build` made; copies share it

    def __repr__(self) -> str:
        """The study in a line, e.g. in a notebook."""
        return f"<study: {self.title}, seed {self.seed}>"

    @property
    def config(self) -> Mapping[str, Any]:
        """The plain, resolved config."""
        return self.composition.config

    @property
    def choices(self) -> Mapping[str, str]:
        """The chosen option of every config group."""
        return self.composition.choices

    @property
    def components(self) -> list[Any]:
        """All that a trial's config determines."""
        return [getattr(self, each.name) for each in fields(self) if each.name not in BESIDE]

    @property
    def as_composed(self) -> bool:
        """Whether no component was replaced since `build`."""
        made = zip(self.components, self.composed, strict=False)
        return bool(self.composed) and all(mine is composed for mine, composed in made)

    @property
    def without_targets(self) -> Study:
        """The study for recording and identifying the robot, whose task has no targets."""
        return replace(self, task=self.task.without_targets) if self.task.targets else self

    @property
    def title(self) -> str:
        """A short title of the choices that distinguish trials."""
        choices = self.choices
        return (
            f"{choices['method']} on {choices['task']}: nominal {choices['nominal']}, "
            f"hardware {choices['hardware']}, bias {choices['bias']}, optimizer {choices['optimizer']}"
        )

    @property
    def hash(self) -> str:
        """The trial's identity, a hash of everything that affects its result."""
        return self.composition.hash

    def run(self, observer: Observer | None = None) -> Iterator[Iteration]:
        """Run the method within the budget; the same seed gives the same records on machines of one kind.

        Raises
        ------
        ConfigError
            If the method ends without an iteration, though its budget is not spent.
        """
        study = replace(
            self, hardware=self.checked_hardware, bias=self.checked_bias, spending=Spending(self.budget)
        )
        with suppress(BudgetSpent):
            run = iter(self.method.run(study, np.random.default_rng(self.seed), observer or Observer()))
            if (first := next(run, None)) is None:
                raise ConfigError("method", f"{type(self.method).__name__}.run yields no iteration")
            yield first
            yield from run

    @property
    def declared_noise(self) -> Noise:
        """The noise that the hardware declares by names of the task's quantities, if any, and pushes."""
        declared = self.config.get("hardware", {}).get("noise")
        try:
            return Noise(self.task, TypeAdapter(Variances).validate_python(declared or QUIET))
        except ValueError:  # a custom class may use the name differently
            return Noise(self.task, QUIET)

    @property
    def max_experiments(self) -> int:
        """The maximum number of hardware experiments, in a trial that never succeeds."""
        return min(self.method.max_experiments, self.budget.experiments or self.method.max_experiments)

    def check(self) -> None:
        """Refuse components that do not go together, before anything is run.

        Raises
        ------
        ConfigError
            Naming the key.
        """
        if isinstance(self.policy, Trajectory) and not self.method.trajectories:
            if self.policy.searched_knots:
                raise ConfigError("policy.searched_knots", "needs a plan to search near: method=trajectory")
            if not is_own(self.method) and getattr(self.method, "first_policy", None) is None:
                raise ConfigError("policy", "follows a plan, so it needs method=trajectory")
        policy = self.config.get("policy", {})
        exact = policy.get("observer") in WITH_NOISE and not policy.get("noise")
        if exact and self.declared_noise.sensor_variance.any():
            words = f"policy.observer={policy['observer']} assumes exact measurements"
            warnings.warn(f"{words}; {OF_HARDWARE}", StudyWarning, stacklevel=2)
        self.method.check(self)

    def simulate(
        self,
        theta: Array,
        fitted_bias: FittedBias | None = None,
        start: Array | None = None,
        nominal: Nominal | None = None,
        disturbance: Disturbance | None = None,
    ) -> Rollout:
        """Roll theta (p,) out in simulation (Eq. 7, 9).

        Defaults: g = 0 without a fitted bias, the task's mean start without a start (n,), the study's nominal
        model without an identified one, and neither noise nor pushes without a disturbance.

        Raises
        ------
        ValueError
            If theta or the start has another shape, or `fitted_bias` is no fitted bias.
        """
        theta = shaped("theta", theta, self.policy.n_parameters)
        begin = shaped("start", self.task.start_mean if start is None else start, len(self.task.states))
        if not isinstance(fitted_bias, FittedBias | None):
            raise ValueError(f"fitted_bias: expected a fitted bias, got {type(fitted_bias).__name__}")
        model = self._corrected(self.policy, fitted_bias, nominal)
        return self._judged(simulator(model, disturbance, self.cost).rollout(theta, begin), theta)

    def experiment(
        self,
        theta: Array,
        rng: np.random.Generator,
        start: Array | None = None,
        observer: Observer | None = None,
    ) -> Rollout:
        """Run theta (p,) on the hardware once; the default start (n,) is drawn by the task.

        Experiments with another start support no claim about the last policy.

        Raises
        ------
        BudgetSpent
            If a trial requests more than its budget allows.
        HardwareError
            If the experiment could not be carried out, did not end in time, or its rollout breaks the
            contract.
        Waiting
            If its result is not available yet.
        ValueError
            If theta or the start has another shape, or `rng` is no generator.
        """
        theta = shaped("theta", theta, self.policy.n_parameters)
        if not isinstance(rng, np.random.Generator):
            raise ValueError(f"rng: expected numpy.random.default_rng(seed), got {type(rng).__name__}")
        begin = self.task.draw_start(rng) if start is None else start
        begin = shaped("start", begin, len(self.task.states))
        watching = observer or Observer()
        self.spending.check()
        watching.experimenting(theta, begin)
        with self.checked_hardware.whole():
            made = self.checked_hardware.run(self.policy, theta, begin, rng).read_only()
            rollout = replace(self._judged(made, theta), given_start=start is not None)
            self.spending.add(rollout.frames, self.task.time_step)
            watching.experimented(rollout)
        return rollout

    def passes(self, rollout: Rollout) -> bool:
        """Whether a rollout with its cost set is a success, decided by the task or else by the cost."""
        succeeds = None if rollout.failed_at is not None else self.task.succeeds(rollout.states)
        return self.cost.passes(rollout) if succeeds is None else succeeds

    @cached_property
    def checked_hardware(self) -> CheckedHardware:
        """The hardware, with experiments limited in time and checked."""
        if isinstance(self.hardware, CheckedHardware):
            return self.hardware
        return CheckedHardware(self.hardware, self.task, self.conditions)

    @property
    def checked_bias(self) -> CheckedBias:
        """The learner, with checked results."""
        return CheckedBias(self.bias, self.task.without_targets)

    def over(self, record: Record) -> Study:
        """The study with searches and experiments that are replayed from a record, then kept in it."""
        hardware = CheckedHardware(self.hardware, self.task, self.conditions, record)
        return replace(self, hardware=hardware, optimizer=ReplayedOptimizer(self.optimizer, record))

    def ask(self) -> ExperimentRequest | None:
        """The next experiment of a trial in which the caller is the hardware; None once the trial has ended.

        >>> while (request := study.ask()) is not None:
        ...     study.tell(run(request.controller(), request.start))

        The trial is only in memory, regardless of `tracking`. Keep the rollouts that you tell: a reloaded
        study asks for the same experiments in the same order, as long as it is told the same rollouts.
        """
        return self.ask_tell.ask()

    def tell(self, rollout: Rollout) -> None:
        """Report the rollout of the requested experiment; the study's hardware is not used.

        Raises
        ------
        ValueError
            If no experiment was requested.
        HardwareError
            If the rollout breaks the contract, or is that of another policy; the request stays open.
        """
        self.ask_tell.tell(rollout)

    @cached_property
    def ask_tell(self) -> AskTell:
        """The ask-and-tell trial; its experiments need no confirmation."""
        unasked = ExperimentConditions(safety=self.conditions.safety)

        def refuse(*_: Any) -> NoReturn:
            raise ConfigError("method", "searches on hardware, which study.ask() does not use")

        def run(record: Record, hardware: Hardware) -> Iterator[Iteration]:
            asked = replace(self, hardware=hardware, hardware_of=refuse, conditions=unasked).over(record)
            return replace(asked, conditions=replace(unasked, confirm=True, ask=refuse)).run()

        return AskTell(self.task.without_targets, run)

    def designed_on(self, model: Model | None) -> Study:
        """The study with its policy designed on a model, if one is given, for simulation and hardware."""
        designed = self.policy if model is None else model.policy
        return self if designed is self.policy else replace(self, policy=designed)

    def with_horizon(self, horizon: int) -> Study:
        """The study with another horizon in frames; its hardware is reconstructed.

        Its costs are those of the old horizon. ValueError if the horizon is no positive whole number.
        """
        if not isinstance(horizon, int | np.integer) or horizon < 1:
            raise ValueError(f"horizon: expected a positive whole number of frames, got {horizon}")
        task = self.task.with_horizon(horizon)
        hardware = self.checked_hardware.with_hardware(self.hardware_of(task), task)
        return replace(self, task=task, hardware=hardware)

    def _judged(self, rollout: Rollout, theta: Array) -> Rollout:
        """A rollout with its cost and the parameters of its policy."""
        return replace(rollout, cost=self.cost.of(rollout), parameters=theta)

    def simulator(self, fitted_bias: FittedBias | None = None, nominal: Nominal | None = None) -> Simulator:
        """The closed loop on the (identified) nominal model, corrected by a fitted bias (default g = 0)."""
        return simulator(self._corrected(self.policy, fitted_bias, nominal), cost=self.cost)

    def model(self, fitted_bias: FittedBias | None = None, nominal: Nominal | None = None) -> Model:
        """The (identified) nominal model, corrected by a fitted bias; g = 0 without one.

        The model-based parts of its policy are designed on this model.
        """
        policy = self.policy if nominal is None else self.policy.designed_on(nominal)
        return self._corrected(policy, fitted_bias, nominal)

    def _corrected(self, policy: Policy, bias: FittedBias | None, nominal: Nominal | None) -> Model:
        """The model with an unchanged policy."""
        fitted = self.bias.fit(self.no_data) if bias is None else bias
        return Model(self.task, policy, nominal or self.nominal, fitted)

    def first_model(self) -> Model:
        """The model before any experiment: as declared, or identified from recordings."""
        return self.model(nominal=self.identified(()))

    def identified(self, rollouts: Sequence[Rollout]) -> Nominal:
        """The nominal model, identified from experiments."""
        return self.identification.fit(self.nominal, self.of_robot(rollouts))

    def select(self, rollouts: Sequence[Rollout], nominal: Nominal) -> Selection:
        """Training data from experiments, with residuals against an (identified) nominal model."""
        return self.samples.select(self.of_robot(rollouts), nominal)

    def of_robot(self, rollouts: Iterable[Rollout]) -> list[Rollout]:
        """Rollouts with only the robot's states: targets are not learned."""
        n = len(self.task.without_targets.states)
        return [rollout.of_states(n) for rollout in rollouts]

    @property
    def no_data(self) -> Transitions:
        """D = {}."""
        return Transitions.empty(len(self.task.without_targets.states), len(self.task.inputs))
