"""The files of a trial: hardware experiments, policies and the data set, written and read back."""

from __future__ import annotations

import json
import re
import sys
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from simbias.core import Policy, Quantity, Task
from simbias.core.messages import printable, quote
from simbias.core.parameters import Estimate
from simbias.core.records import Iteration, Rollout, Transitions
from simbias.trial.policy_test import Tries

TEXTS = "UST"  # kinds of NumPy's types that are no numbers
HELD_OUT = "held_out.csv"  # the tries of the last policy
SCALARS = ("sensed", "cost", "failed_at", "failure")  # of a rollout


def experiment_name(iteration: int, experiment: int) -> str:
    """The file of a hardware experiment."""
    return f"experiments/iteration_{iteration:02d}_experiment_{experiment}.npz"


def policy_name(iteration: int) -> str:
    """The file of an iteration's policy."""
    return f"policies/iteration_{iteration:02d}.json"


def parameters_name(iteration: int) -> str:
    """The file of the nominal model's parameters, as identified before an iteration's policy was searched."""
    return f"parameters/iteration_{iteration:02d}.json"


def data_name(iteration: int) -> str:
    """The file of the data set D that an iteration ended with."""
    return f"data/iteration_{iteration:02d}.npz"


def held_out_text(tries: Tries, task: Task) -> str:
    """A row for each held-out start, with how long the policy was asked to last and how long it did."""
    import pandas as pd  # lazily: workers do without it

    names = [*(state.name for state in task.states), "asked_seconds", "lasted_seconds", "failure"]
    rows = [(*one.start.tolist(), one.asked, one.seconds, one.failure or "") for one in tries.each]
    return pd.DataFrame(rows, columns=names).to_csv(index=False, float_format="%.6g", lineterminator="\n")


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


def save_arrays(file: IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as compressed npz, without pickle."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:  # savez cannot take every name
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)


def raw_parts(returned: Any) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """The parts by name of whatever a hardware returned: those that are numbers, and the others as text.

    Parts are the fields of an object, the items of a mapping or of a list that is no array; else there is
    one, `returned`.
    """
    arrays: dict[str, NDArray[Any]] = {}
    texts: dict[str, str] = {}
    for name, part in _parts(returned).items():
        try:
            array = np.asarray(part)
            if array.dtype.hasobject or array.dtype.kind in TEXTS:
                raise TypeError("no numbers")
        except Exception:
            texts[name] = _text(part)
        else:
            arrays[name] = array
    return arrays, texts


def _parts(returned: Any) -> dict[str, Any]:
    """The parts of an object, by names that a file may have."""
    named: Iterable[tuple[Any, Any]] = [("returned", returned)]
    if not _is_array(returned):
        if isinstance(returned, Mapping):
            named = returned.items()
        elif isinstance(returned, list | tuple):
            named = enumerate(returned)
        elif getattr(returned, "__dict__", None):
            named = vars(returned).items()
    parts: dict[str, Any] = {}
    for name, part in named:
        key = re.sub(r"\W", "_", name if isinstance(name, str) else quote(name))
        while key in parts:
            key += "_"
        parts[key] = part
    return parts


def _is_array(thing: Any) -> bool:
    """Whether NumPy makes one array of numbers of it."""
    try:
        return not np.asarray(thing).dtype.hasobject
    except Exception:
        return False


def _text(thing: Any) -> str:
    """A thing in words, every number of it in full."""
    try:
        with np.printoptions(threshold=sys.maxsize, precision=17):
            return printable(repr(thing))
    except Exception:
        return f"a {type(thing).__name__} that cannot be shown"


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


def parameters_text(estimates: Sequence[Estimate]) -> str:
    """Identified parameters as JSON: declared and most probable values, and a 90% interval."""
    return json.dumps([estimate._asdict() for estimate in estimates], indent=2)


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
                **({"flat": True} if optimum.flat else {}),
            },
        }
    return json.dumps(content, indent=2) + "\n"
