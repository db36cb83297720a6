"""Requests of a small robot, and the files that a lab sends back."""

from pathlib import Path

import numpy as np
from point_mass import PointMass, Spring

from simbias.core import Criterion, Quantity, Task
from simbias.core.records import Array
from simbias.lab.requests.request import ExperimentRequest
from simbias.lab.safety import Safety, SafetyLimitedPolicy

THETA = np.array([4.0, 4.0, -2.0])


class Pole(PointMass):
    """Angles in radians, to be held within 0.4 of upright."""

    states = (Quantity("angle", "rad"), Quantity("rate", "rad/s"))
    inputs = (Quantity("torque", "N m"),)
    outputs = states
    criteria = (Criterion("falls", "it falls", 0.4, "rad"),)
    start_deviation = np.array([0.02, 0.02])


def requested(task: Task, start: Array, safety: Safety | None = None) -> ExperimentRequest:
    """A request to a lab, under these limits."""
    policy = Spring(task)  # type: ignore[arg-type]
    if safety is None:
        return ExperimentRequest(task, policy, THETA, start)
    limited = SafetyLimitedPolicy(policy, task, safety.bounds(task))
    return ExperimentRequest(task, limited, THETA, start)


def lines(names: str, table: Array, failure: str = "") -> list[str]:
    """The lines of a CSV file: a header, and rows whose last cell is empty but for the last row's."""
    rows = [",".join(map(repr, row)) + "," for row in table.tolist()]
    rows[-1] += failure
    return [names, *rows]


def written(folder: Path, text: list[str]) -> Path:
    """The file of these lines."""
    path = folder / "trajectory.csv"
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    return path
