"""What a person should know of a trial under way, before more hardware is spent: told at once, in a line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from simbias.core.records import Array, Iteration, Search, Selection


class Remark(NamedTuple):
    """Something odd about a trial."""

    kind: str  # in few words, the same whenever it happens
    words: str  # in one line, with its numbers


def of_policy(theta: Array, search: Search | None, earlier: Sequence[Iteration]) -> Iterator[Remark]:
    """What is odd about a policy theta (p,), searched or not, that was made after earlier iterations."""
    if search is not None and search.optimum.flat:
        optimum = search.optimum
        yield Remark(
            "all simulated policies cost the same",
            f"all {optimum.evaluations} simulated policies cost the same ({optimum.cost:g}), so this one is "
            f"arbitrary; does every simulation fail at once, or start at rest in an equilibrium?",
        )
    same = [each.index for each in earlier if np.array_equal(each.parameters, theta)]
    if same:
        yield Remark(
            "a refuted policy was tried again",
            f"this is the policy of iteration {same[0]} again, which the hardware has refuted: what was "
            "learned since has changed nothing",
        )


def of_reset(iteration: Iteration, max_cost: float) -> Iterator[Remark]:
    """Why the model was cleared after an iteration's search, if it was (line 7 of Algorithm 1)."""
    search = iteration.search
    if search is not None and iteration.learning is not None and iteration.learning.reset:
        yield Remark(
            "model cleared",
            f"model cleared: no policy of the corrected simulation costs less than Z_max = {max_cost:g} "
            f"({search.predicted_cost:.3g} at best, of {search.optimum.evaluations} simulated); is the task "
            "possible within its limits and horizon?",
        )


def of_selection(selection: Selection) -> Iterator[Remark]:
    """Why nothing could be learned from an iteration's experiments, if so."""
    if len(selection.transitions):
        return
    if selection.sampled:
        rejected = ", ".join(f"{name} {count}" for name, count in selection.rejected.items() if count)
        why = f"all {selection.sampled} were rejected: {rejected or 'nobody says why'}"
    else:
        why = selection.note or f"none of {selection.frames} frames was sampled"
    yield Remark("experiments without a sample to learn from", f"no samples to learn from: {why}")


def of_iteration(iteration: Iteration, earlier: Sequence[Iteration]) -> list[Remark]:
    """Everything odd about an iteration that has ended, but that the model was cleared, which is no fault."""
    found = list(of_policy(iteration.parameters, iteration.search, earlier))
    if iteration.learning is not None and not iteration.succeeded:
        found += of_selection(iteration.learning.selection)
    return found


def of_trial(iterations: Sequence[Iteration]) -> list[Remark]:
    """Everything odd about the iterations of a trial."""
    return [remark for i, each in enumerate(iterations) for remark in of_iteration(each, iterations[:i])]
