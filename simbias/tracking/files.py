"""The files of a trial: hardware experiments, policies and the data set, written and read back."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simbias.interfaces import Policy, Quantity, Task
from simbias.records import Array, Iteration, Rollout, Transitions

SCALARS = ("sensed", "cost", "failed_at", "failure")  # of a rollout


def save_rollout(path: Path, theta: Array, rollout: Rollout) -> None:
    """Write a rollout of the policy theta (p,) as compressed npz; what is None is left out.

    Fields: parameters (p,), states (k+1, n), inputs (k, m), measured (k+1, n), sensed, cost, failed_at,
    failure.
    """
    fields = {
        "parameters": theta,
        "states": rollout.states,
        "inputs": rollout.inputs,
        "measured": rollout.measured,
        "sensed": rollout.sensed,
        "cost": rollout.cost,
        "failed_at": rollout.failed_at,
        "failure": rollout.failure,
    }
    given: dict[str, Any] = {name: value for name, value in fields.items() if value is not None}
    np.savez_compressed(path, **given)


def load_rollout(path: Path) -> tuple[Array, Rollout]:
    """The policy theta (p,) and its rollout, as `save_rollout` wrote them."""
    with np.load(path) as file:
        fields = {name: file[name] for name in file.files}
    scalars = {name: fields.pop(name).item() for name in SCALARS if name in fields}
    return fields.pop("parameters"), Rollout(**fields, **scalars)


def save_transitions(path: Path, transitions: Transitions, task: Task) -> None:
    """Write training data as compressed npz, with the names and units of the columns.

    Fields: inputs (N, n+m), input_names (n+m,), input_units (n+m,), residuals (N, n), residual_names (n,),
    residual_units (n,).
    """
    input_names, input_units = _columns((*task.states, *task.inputs))
    residual_names, residual_units = _columns(task.states)
    np.savez_compressed(
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
    optimum = iteration.optimum
    gains = getattr(policy, "gains", None)
    content = {
        "iteration": iteration.index,
        "parameters": optimum.parameters.tolist(),
        **({"gains": np.asarray(gains(optimum.parameters)).tolist()} if callable(gains) else {}),
        "predicted_cost": iteration.predicted_cost,
        "hardware_cost": iteration.hardware_cost,
        "succeeded": iteration.succeeded,
        "search": {
            "cost": optimum.cost,
            "evaluations": optimum.evaluations,
            "stopped_by": optimum.stopped_by,
        },
    }
    return json.dumps(content, indent=2) + "\n"
