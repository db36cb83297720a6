"""The files of a trial: hardware experiments, policies and the data set, written and read back."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from simbias.interfaces import Policy, Quantity, Task
from simbias.records import Iteration, Rollout, Transitions

SCALARS = ("sensed", "cost", "failed_at", "failure")  # of a rollout


def experiment_name(iteration: int, experiment: int) -> str:
    """The file of a hardware experiment."""
    return f"experiments/iteration_{iteration:02d}_experiment_{experiment}.npz"


def policy_name(iteration: int) -> str:
    """The file of an iteration's policy."""
    return f"policies/iteration_{iteration:02d}.json"


def data_name(iteration: int) -> str:
    """The file of the data set D that an iteration ended with."""
    return f"data/iteration_{iteration:02d}.npz"


def save_rollout(file: Path | IO[bytes], rollout: Rollout) -> None:
    """Write a rollout as npz; what is None is left out.

    Compressed, it would be 5% smaller, and take 20 times as long.

    Fields: parameters (p,), states (k+1, n), inputs (k, m), measured (k+1, n), sensed, cost, failed_at,
    failure.
    """
    given: dict[str, Any] = {name: value for name, value in vars(rollout).items() if value is not None}
    np.savez(file, **given)


def load_rollout(path: Path) -> Rollout:
    """The rollout, as `save_rollout` wrote it."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    scalars = {name: arrays.pop(name).item() for name in SCALARS if name in arrays}
    return Rollout(**arrays, **scalars)


def save_transitions(path: Path, transitions: Transitions, task: Task) -> None:
    """Write training data as npz, with the names and units of the columns.

    Fields: inputs (N, n+m), input_names (n+m,), input_units (n+m,), residuals (N, n), residual_names (n,),
    residual_units (n,).
    """
    input_names, input_units = _columns((*task.states, *task.inputs))
    residual_names, residual_units = _columns(task.states)
    np.savez(
        path,
        inputs=transitions.inputs,
        input_names=input_names,
        input_units=input_units,
        residuals=transitions.residuals,
        residual_names=residual_names,
        residual_units=residual_units,
    )


def _columns(quantities: Sequence[Quantity]) -> tuple[list[str], list[str]]:
    """Names and units."""
    return [quantity.name for quantity in quantities], [quantity.unit for quantity in quantities]


def load_transitions(path: Path) -> Transitions:
    """Training data, as `save_transitions` wrote it."""
    with np.load(path) as file:
        return Transitions(file["inputs"], file["residuals"])


def policy_text(policy: Policy, iteration: Iteration) -> str:
    """An iteration's policy as JSON: theta (p,), its gains if the policy has such, costs and search."""
    search, gains = iteration.search, getattr(policy, "gains", None)
    content: dict[str, Any] = {
        "iteration": iteration.index,
        "parameters": iteration.parameters.tolist(),
        **({"gains": np.asarray(gains(iteration.parameters)).tolist()} if callable(gains) else {}),
        "hardware_cost": iteration.hardware_cost,
        "succeeded": iteration.succeeded,
    }
    if search is not None:
        optimum = search.optimum
        content |= {
            "predicted_cost": search.predicted_cost,
            "search": {
                "cost": optimum.cost,
                "evaluations": optimum.evaluations,
                "stopped_by": optimum.stopped_by,
            },
        }
    return json.dumps(content, indent=2) + "\n"
