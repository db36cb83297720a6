"""The contract of every component, for authors of components.

| author of | reads |
| --- | --- |
| a task, hardware | `robot.py` |
| a policy | `policy.py` |
| a nominal model, identification, samples, a bias | `model.py` |
| a cost, an evaluation, an optimizer | `search.py`, `objective.py` |
| compiled functions | `simbias.simulation.compiler.kernels` |
| a method | `simbias.trial.method`, and `simbias.trial.study`, which a method runs |

All names are imported from here.

Symbols: n states x, m inputs u, q outputs z, p policy parameters theta, s numbers of a policy's internal
state; T frames of `time_step` seconds. Units are the task's. Components are built from YAML: the keys of
`conf/<group>/<name>.yaml` are the constructor's arguments, checked against its annotations; an argument named
`task` receives the task. A component that reads files lists their paths as `source_files`, so that a resumed
trial reports changed files. Arrays hold floats. State is passed, never hidden; randomness comes only from a
passed NumPy generator.

A shape that begins with `...` allows any leading axes, as in NumPy's own functions: a policy search simulates
all its candidates in lockstep. Methods in ordinary vectorised NumPy are compiled for this; results differ
only by rounding. A component may provide a `kernel` instead (`simbias.simulation.compiler.kernels`).
"""

from simbias.core.errors import StudyWarning
from simbias.core.model import Bias, FittedBias, Identification, Kernel, Model, Nominal, Samples
from simbias.core.objective import Objective
from simbias.core.policy import Controller, Law, Policy
from simbias.core.quantities import Quantity, rate_pairs, rates_and_positions, wrapped
from simbias.core.robot import (
    NOT_A_NUMBER,
    Criterion,
    Hardware,
    HardwareError,
    Push,
    Task,
    Waiting,
    failure_name,
)
from simbias.core.search import Cost, Evaluation, GoalWeights, Optimizer, Simulator

__all__ = [
    "NOT_A_NUMBER",
    "Bias",
    "Controller",
    "Cost",
    "Criterion",
    "Evaluation",
    "FittedBias",
    "GoalWeights",
    "Hardware",
    "HardwareError",
    "Identification",
    "Kernel",
    "Law",
    "Model",
    "Nominal",
    "Objective",
    "Optimizer",
    "Policy",
    "Push",
    "Quantity",
    "Samples",
    "Simulator",
    "StudyWarning",
    "Task",
    "Waiting",
    "failure_name",
    "rate_pairs",
    "rates_and_positions",
    "wrapped",
]
