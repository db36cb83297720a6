"""What a person should know of a trial under way, before more hardware is spent: told at once, in a line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from simbias.core.records import Iteration, Search, Selection


def of_search(search: Search, earlier: Sequence[Iteration]) -> Iterator[str]:
    """What is odd about the policy that a search found, after earlier iterations."""
    optimum = search.optimum
    if optimum.flat:
        yield (
            f"all {optimum.evaluations} simulated policies cost the same ({optimum.cost:g}), so this one is "
            f"arbitrary; does every simulation fail at once, or start at rest in an equilibrium?"
        )
    same = [each.index for each in earlier if np.array_equal(each.parameters, optimum.parameters)]
    if same:
        yield (
            f"this is the policy of iteration {same[0]} again, which the hardware has refuted: what was "
            "learned since has changed nothing in the search"
        )


def of_selection(selection: Selection) -> Iterator[str]:
    """Why nothing could be learned from an iteration's experiments, if so."""
    if len(selection.transitions):
        return
    if selection.sampled:
        rejected = ", ".join(f"{name} {count}" for name, count in selection.rejected.items() if count)
        why = f"all {selection.sampled} were rejected: {rejected or 'nobody says why'}"
    else:
        why = selection.note or f"none of {selection.frames} frames was sampled"
    yield f"no samples to learn from: {why}"


def kinds(iterations: Sequence[Iteration]) -> set[str]:
    """What is odd about a trial that has ended, in few words each."""
    found = set()
    for index, iteration in enumerate(iterations):
        if iteration.search is not None and iteration.search.optimum.flat:
            found.add("all simulated policies cost the same")
        if any(np.array_equal(each.parameters, iteration.parameters) for each in iterations[:index]):
            found.add("a refuted policy was tried again")
        learning = iteration.learning
        if learning is not None and not iteration.succeeded and not len(learning.selection.transitions):
            found.add("experiments without a sample to learn from")
    return found


def of_iteration(iteration: Iteration, earlier: Sequence[Iteration]) -> list[str]:
    """All remarks on an iteration that has ended."""
    found = [] if iteration.search is None else list(of_search(iteration.search, earlier))
    if iteration.learning is not None and not iteration.succeeded:
        found += of_selection(iteration.learning.selection)
    return found
