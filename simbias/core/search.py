"""Policy search in simulation: costs, objectives, and the optimizers that minimise them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, Literal, NamedTuple, Protocol, Self

import numpy as np

from simbias.core.evaluations import Evaluations, SearchBudget
from simbias.core.model import Model
from simbias.core.objective import Near, Objective, as_objective
from simbias.core.records import Array, Indices, Optimum, Rollout

Reduction = Literal["sum", "max"]


class Simulator(Protocol):
    """The closed loop of policy, nominal model and bias (Eq. 7, 9), with or without noise."""

    def rollout(self, theta: Array, start: Array) -> Rollout:
        """Run theta (p,) from start (n,) until failure or the horizon; the rollout's cost is not set."""

    def rollouts(self, thetas: Array, starts: Array) -> Sequence[Rollout]:
        """Run each theta of (k, p) from its start of (k, n) in lockstep, much faster than one by one."""

    def costs(self, cost: Cost, thetas: Array, starts: Array) -> tuple[Array, Indices]:
        """Costs (k,) of these rollouts, and their numbers of frames (k,); faster than `rollouts`."""


class GoalWeights(NamedTuple):
    """Diagonal weights of a cost that is quadratic about the goal."""

    errors: Array  #: (g,) of squared errors, 1/s
    inputs: Array  #: (m,) of squared inputs, 1/s
    final: Array  #: (g,) of the last squared error


class Cost(ABC):
    """The cost of a rollout, and the limit above which a policy has failed.

    Most costs sum terms of single frames, or take their maximum. They define `reductions`, `terms` and
    `of_totals`, and are accumulated during the simulation. Other costs override `of`; then every simulated
    rollout is recorded, which takes longer.
    """

    max_cost: float  #: Z_max
    horizon: int  #: T, frames of a rollout that does not fail
    time_step: float  #: s
    reductions: tuple[Reduction, ...] = ()  #: for each of the s terms: how it is reduced to its total
    goal_weights: GoalWeights | None = None  #: if it is quadratic about the goal, up to a factor

    def terms(self, x_next: Array, u: Array, t: Any) -> Array:
        """Terms (..., s) of frames that end in x_next (..., n) at the time t (...) in s, under u (..., m).

        They are numbers wherever the task does not fail.
        """
        raise NotImplementedError(f"{type(self).__name__} has neither `terms` nor its own `of`")

    def of_totals(self, totals: Array, lost: Indices) -> Array:
        """Z (...) of rollouts with these totals (..., s) and numbers of frames (...) lost by failure: finite.

        Totals start at zero, so no maximum is below zero.
        """
        raise NotImplementedError(f"{type(self).__name__} has no `of_totals`")

    def of(self, rollout: Rollout) -> float:
        """Z of a rollout: finite. A frame that ends in a non-finite state fails; nan terms are left out."""
        t = self.time_step * np.arange(1, rollout.frames + 1)
        with np.errstate(over="ignore", invalid="ignore"):  # a simulated state may overflow
            terms = self.terms(rollout.states[1:], rollout.inputs, t)
            if terms.shape != (shape := (rollout.frames, len(self.reductions))):
                raise ValueError(f"terms: expected shape {shape}, got {terms.shape}")
            totals = [
                np.nansum(term) if reduction == "sum" else np.fmax.reduce(term, initial=0.0)
                for reduction, term in zip(self.reductions, terms.T, strict=True)
            ]
        lost = 0 if rollout.failed_at is None else self.horizon - rollout.failed_at
        return float(self.of_totals(np.array(totals), np.array(lost)))

    def oddity(self, rollout: Rollout) -> tuple[str, str] | None:
        """An oddity of the cost of a rollout, in few words and in a sentence; None if there is none."""
        return None

    def with_horizon(self, horizon: int) -> Self:
        """The cost of rollouts of at most `horizon` frames."""
        if not self.reductions:
            raise NotImplementedError(
                f"{type(self).__name__} has no `with_horizon`, which evaluation.seconds needs"
            )
        other = copy(self)
        other.horizon = horizon
        return other

    def passes(self, rollout: Rollout) -> bool:
        """Whether a rollout, its cost set, is a success: no failure, and Z < Z_max."""
        return rollout.failed_at is None and rollout.cost < self.max_cost


class Evaluation(ABC):
    """Prediction of a policy's cost in simulation."""

    rollouts: int = 1  #: simulated per policy
    horizon: int | None = None  #: frames of its rollouts; None: the task's
    draws_nominal: bool = False  #: whether each rollout uses a drawn nominal model

    @abstractmethod
    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Objective:
        """The predicted cost as a function of theta; its samples are drawn once, from rng.

        `simbias.simulation.closed_loop.simulator` simulates a model. `model.nominal.draw` and
        `model.bias.draw` draw from what is known, `model.nominal.parameters` may still be the prior.
        """


class Optimizer(SearchBudget, ABC):
    """A minimiser over a box; its constructor takes its budget and its other settings."""

    @abstractmethod
    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Evaluate points of a box until a stopping criterion is met; return it in words.

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
        target_cost: float = np.inf,
        candidates: Iterable[Array] = (),
        directions: Callable[[Array], Array] | None = None,
    ) -> Optimum:
        """The best point found in lower (p,) <= theta <= upper (p,); the objective's exceptions propagate.

        The budget limits the search. It may end earlier by convergence only if its best cost is below
        `target_cost`: among failing policies, costs of Eq. 8 lie on plateaus that look like convergence. The
        candidates (p,) are evaluated first; a search that needs a starting point starts from the best of
        them. If the objective has a first stage, that is searched before, with its own budget, until it is
        below the target if there is one; its best point is one more candidate.

        If candidates have `directions` (d, p), only points near the best one are searched, by -1 to 1 along
        each of its directions. Candidates and this search then have a budget each.

        Raises
        ------
        ValueError
            If the box is empty or not finite, a cost is not finite, or directions are not finite or not of
            shape (d, p).
        """
        first = list(candidates)  # before the clock starts: making them may take a while
        if first and directions is not None and len(directions(first[0])):
            tried = Evaluations(objective, lower, upper, self, target_cost)
            tried.try_first(first)
            chosen = directions(tried.start)
            near, edge = Near(objective, tried.start, chosen, lower, upper), np.ones(len(chosen))
            found = self.minimize(near, -edge, edge, rng, target_cost, [np.zeros_like(edge)])
            evaluations = found.evaluations + tried.count
            return replace(found, parameters=near.points(found.parameters), evaluations=evaluations)
        easier, spent = as_objective(objective).first_stage, 0
        if easier is not None:
            ends = target_cost < np.inf
            first_stage = Evaluations(easier, lower, upper, self, target_cost, ends_at_target=ends)
            begun = self._minimum(first_stage, rng, first)
            first, spent = [*first, begun.parameters], begun.evaluations
        optimum = self._minimum(Evaluations(objective, lower, upper, self, target_cost), rng, first)
        return replace(optimum, evaluations=optimum.evaluations + spent)

    def _minimum(
        self, evaluations: Evaluations, rng: np.random.Generator, candidates: Sequence[Array]
    ) -> Optimum:
        """The best point of one search that begins with the candidates (p,)."""
        evaluations.try_first(candidates)
        return evaluations.optimum(evaluations.run(lambda running: self.search(running, rng)))
