"""What comes from a lab, and what goes there: CSV files, and controllers of random policies."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from attack.verdict import Result, Verdict
from simbias.config import compose
from simbias.config.build import build
from simbias.core import HardwareError, Policy, Task
from simbias.core.messages import brief, with_type
from simbias.core.records import Array
from simbias.lab.requests.request import HEADER, MODULE, ExperimentRequest
from simbias.lab.requests.trajectory import header, read
from simbias.lab.requests.verification import difference
from simbias.lab.safety import Bounds, SafetyLimitedPolicy
from simbias.trial.study import Study

TASKS = [
    "preset=cartpole",
    "preset=acrobot_swingup",
    "preset=pendubot_swingup",
    "preset=double_pendulum",
    "seed=0",
]
POLICIES = {
    "output_feedback": {},
    "integral_feedback": {},
    "dynamic_output_feedback": {
        "filter_seconds": 0.05, "integral_rate": 3.0, "delay_seconds": 0.02, "constant": 0.3,
    },
    "mlp": {"units": 4},
    "rbf": {"units": 3},
    "switched": {"units": 4},
}  # fmt: skip
OBSERVERS = ("none", "filter", "derivative", "model")  # of networks
STRANGE = [0.0, -0.0, 5e-324, 1e-300, 1e6, 1e300, -1e308, np.inf, -np.inf, np.nan]
_STUDIES: dict[tuple[str, ...], Study | str] = {}


def study_of(*overrides: str) -> Study | str:
    """The study of a config, or why there is none."""
    if overrides not in _STUDIES:
        try:
            with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
                _STUDIES[overrides] = build(compose(overrides))
        except ValueError as error:
            _STUDIES[overrides] = with_type(error)
    return _STUDIES[overrides]


def judged(surface: str, case: str, attack: Callable[[], str]) -> list[Result]:
    """The result of an attack in this process: "" if all is well, a line that refuses, or what is wrong."""
    began, verdict = time.monotonic(), Verdict.RAN
    try:
        said = attack()
    except (HardwareError, ValueError) as error:
        said, verdict = str(error), Verdict.REFUSED if "\n" not in str(error) else Verdict.LINES
    except Exception as error:
        said, verdict = with_type(error), Verdict.TRACEBACK
    if said and verdict is Verdict.RAN:
        verdict = Verdict.WRONG
    seconds = round(time.monotonic() - began, 1)
    return [Result(surface, brief(case, 200), verdict, 0, seconds, brief(said or "as it should", 200))]


# Controllers


ONE = [
    *(np.sin, np.cos, np.tanh, np.abs, np.sign, np.floor, np.negative, np.arctan, np.square),
    *(lambda a: np.sqrt(np.abs(a)), lambda a: np.exp(np.minimum(a, 3.0)), lambda a: np.clip(a, -1.0, 0.5)),
]
TWO = [
    *(np.add, np.subtract, np.multiply, np.minimum, np.maximum, np.arctan2, np.copysign),
    *(lambda a, b: np.where(a > b, a, b * b), lambda a, b: a / (1.0 + np.abs(b))),
    lambda a, b: np.where((a < 0) & ~(b >= 0), b, a),
]


class Formula(Policy):
    """A law of random operations, with a state of two values and the time, as somebody writes it in NumPy."""

    n_parameters, state_size = 3, 2
    bounds = (-np.ones(3), np.ones(3))

    def __init__(self, task: Task, number: int) -> None:
        self._task, self._number = task, number

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        rng = random.Random(self._number)
        known = [given[..., i : i + 1] for given in (x, theta, policy_state) for i in range(given.shape[-1])]
        known += [0.0 * x[..., :1] + t, 0.0 * x[..., :1] + rng.uniform(-3, 3)]

        def value(depth: int) -> Any:
            if depth == 0 or rng.random() < 0.1:
                return rng.choice(known)
            if rng.random() < 0.4:
                return rng.choice(ONE)(value(depth - 1))
            return rng.choice(TWO)(value(depth - 1), value(depth - 1))

        u = np.concatenate([10.0 * value(rng.randint(1, 5)) for _ in self._task.inputs], axis=-1)
        kept = np.concatenate([np.clip(value(rng.randint(1, 4)), -5.0, 5.0) for _ in range(2)], axis=-1)
        return np.clip(u, *self._task.input_bounds), kept


def controllers(rng: random.Random, work: Path) -> list[Result]:
    """C and Python of a random policy with random limits, over frames near, at and beyond these."""
    kind, task = rng.choice([*sorted(POLICIES), "formula", "formula"]), rng.choice(TASKS)
    values = {**POLICIES.get(kind, {})}
    if kind in ("mlp", "rbf", "switched"):
        values["observer"] = rng.choice(OBSERVERS)
        values["units"] = rng.randint(1, 6)
    elif kind == "dynamic_output_feedback":
        values = {key: rng.choice([0.0, value * 10 ** rng.uniform(-1, 0.3)]) for key, value in values.items()}
    chosen = tuple(f"policy.{key}={value}" for key, value in values.items())
    number = rng.randrange(10**9)
    case = f"{task} {kind} {' '.join(chosen)} {number}"

    def attack() -> str:
        study = study_of(task, *([f"policy={kind}"] if kind in POLICIES else []), *chosen)
        if isinstance(study, str):
            raise ValueError(study)
        own = np.random.default_rng(number)
        law = study.policy if kind in POLICIES else Formula(study.task, number)
        policy, bounds = _limited(law, study.task, own)
        lower, upper = law.bounds
        theta = own.uniform(lower, upper) * own.choice([0.0, 0.01, 0.3, 1.0])
        theta = np.clip(theta, lower, upper)
        request = ExperimentRequest(study.task, policy, theta, study.task.start_mean)
        if why := request.why_no_code:
            return why if why.startswith("in ") else ""  # a law that cannot be traced has no code
        code = request.code('an attack: */ """ \\ // <b>\n#error')
        if found := difference(policy, study.task, theta, bounds, code[HEADER], code[MODULE]):
            return found
        return _against_python(request, code[MODULE], own)

    return judged("controllers", case, attack)


def _limited(policy: Policy, task: Task, rng: np.random.Generator) -> tuple[SafetyLimitedPolicy, Bounds]:
    """The policy with random limits, the inputs' own on either side, and failure criteria or not."""
    lower, upper = (np.array(edge, dtype=np.float64) for edge in task.input_bounds)
    size = np.maximum(np.abs(lower), np.abs(upper))
    lower = np.where(rng.random(len(size)) < 0.5, np.maximum(lower, -size * rng.uniform(0.2, 1.0)), lower)
    rates = rng.choice([np.inf, 1e9, 1e4, 1e2], len(size))
    states = rng.choice([np.inf, 10.0, 1.0], len(task.states))
    bounds = Bounds((lower, upper), rates, states, bool(rng.random() < 0.5))
    return SafetyLimitedPolicy(policy, task, bounds), bounds


def _against_python(request: ExperimentRequest, module: str, rng: np.random.Generator) -> str:
    """The first frame at which the module differs from the policy, at limits, strange sizes and NaN."""
    names: dict[str, Any] = {}
    exec(compile(module, "<controller.py>", "exec"), names)
    task = request.task
    made, policy = names["Controller"](), request.policy.controller(request.theta, task.time_step)
    for frame in range(60):
        x = task.start_mean + rng.standard_normal(len(task.states)) * 10.0 ** rng.uniform(-3, 1)
        limits = request.bounds.states
        if rng.random() < 0.2:
            index = rng.integers(len(x))
            x[index] = rng.choice([limits[index], -limits[index], np.nextafter(limits[index], np.inf)])
        if frame > 40 and rng.random() < 0.2:
            x[rng.integers(len(x))] = rng.choice(STRANGE)
        told, expected = _told(made, x), _told(policy, x)
        if not np.allclose(told, expected, 1e-9, 1e-9, equal_nan=True):
            return f"frame {frame}, x {x.tolist()}: {told.tolist()}, the policy {expected.tolist()}"
    return ""


def _told(controller: Any, x: Array) -> Array:
    """The inputs (m,) of a controller; NaN where it aborts."""
    try:
        with np.errstate(all="ignore"):
            return np.array(controller(x), dtype=np.float64)
    except Exception:  # UnsafeError or ValueError
        return np.array([np.nan])


# Experiments that a person brings

CELLS = [
    *("", " ", "nan", "inf", "-inf", "1e400", "1_2", "0x10", "١٢", "1,5", "1.5.2", "--1", "+", "1e", "None"),
    *("=1+1", "1 2", "\x00", "12;3", '"', "1\u00a0000", "\u22121", "1e-400", "true", "<script>", "9" * 400),
]


def _rows(request: ExperimentRequest) -> list[list[str]]:
    """A file as it should be: header and all rows."""
    task, x = request.task, request.start
    controller, rows = request.policy.controller(request.theta, task.time_step), [header(task)]
    for frame in range(task.horizon + 1):
        u = np.clip(controller(x), *task.input_bounds)
        rows.append([repr(frame * task.time_step), *map(repr, x.tolist()), *map(repr, u.tolist()), ""])
    return rows


def _text(rows: list[list[str]], separator: str = ",", end: str = "\n") -> str:
    """The text of rows."""
    return end.join(separator.join(row) for row in rows) + end


def experiments(rng: random.Random, work: Path) -> list[Result]:
    """A CSV file that is changed in one place: refused in a line with its name, or read as it was."""
    study = study_of("preset=cartpole", "task.horizon=20")
    assert not isinstance(study, str)
    request = ExperimentRequest(
        study.task, study.policy, np.zeros(study.policy.n_parameters), study.task.start_mean
    )
    rows = _rows(request)
    kind = rng.choice(["cell", "cell", "cell", "rows", "columns", "form", "bytes", "scale"])
    case, text, harmless = _changed(kind, rows, rng)

    def attack() -> str:
        with TemporaryDirectory(prefix="attack-") as folder:
            whole, file = Path(folder, "whole.csv"), Path(folder, "trajectory.csv")
            whole.write_text(_text(rows), encoding="utf-8")
            file.write_bytes(text)
            right = read(whole, request)
            try:
                found = read(file, request)
            except HardwareError as error:
                if str(file) not in str(error):
                    return f"no file named: {error}"
                if harmless:
                    return f"refused: {error}"
                raise
            same = found.states.shape == right.states.shape and np.allclose(found.states, right.states)
            same = same and np.allclose(found.inputs, right.inputs) and found.failure == right.failure
            return "" if same or harmless is None else f"taken in: {found.failed_at} {found.failure}"

    return judged("experiments", case, attack)


def _changed(kind: str, rows: list[list[str]], rng: random.Random) -> tuple[str, bytes, bool | None]:
    """What is changed, the file, and whether it has to be read as before; None if either is right."""
    rows = [list(row) for row in rows]
    index, column = rng.randrange(1, len(rows)), rng.randrange(len(rows[0]) - 1)
    last_input = index == len(rows) - 1 and column >= len(rows[0]) - 2
    if kind == "cell":
        cell = rng.choice(CELLS)
        rows[index][column] = cell
        same = (cell.strip() == "" and last_input) or (column and cell in ("1e-400",))
        return f"row {index + 1}, column {column}: {cell!r}", _text(rows).encode(), None if same else False
    if kind == "rows":
        what = rng.choice(["twice", "gone", "swapped", "blank", "half"])
        other = rng.randrange(1, len(rows))
        changes: dict[str, Callable[[], object]] = {
            "twice": lambda: rows.insert(index, rows[index]),
            "gone": lambda: rows.pop(index),
            "swapped": lambda: rows.__setitem__(slice(None), [
                rows[{index: other, other: index}.get(i, i)] for i in range(len(rows))
            ]),
            "blank": lambda: rows.insert(index, []),
            "half": lambda: rows.__setitem__(index, rows[index][: column or 1]),
        }  # fmt: skip
        changes[what]()
        right = {"blank": True, "gone": None, "swapped": None if index == other else False}
        return f"{what} {index}", _text(rows).encode(), right.get(what, False)
    if kind == "columns":
        order = rng.sample(range(len(rows[0])), len(rows[0]))
        what = rng.choice(["order", "more", "twice", "unit", "name"])
        if what == "order":
            return what, _text([[row[i] for i in order] for row in rows]).encode(), True
        if what == "more":
            return what, _text([["x" if not i else "7", *row] for i, row in enumerate(rows)]).encode(), True
        if what == "twice":
            return what, _text([[*row[:-1], row[column], row[-1]] for row in rows]).encode(), False
        name = rows[0][column]
        rows[0][column] = name.replace("(", "(m") if what == "unit" else name.replace(" (", "_ (")
        return f"{what} {rows[0][column]}", _text(rows).encode(), False
    if kind == "form":
        commas = [[cell.replace(".", ",") for cell in row] for row in rows]
        quoted = [[f'"{cell}"' for cell in row] for row in rows]
        spaced = [[f" {cell} " for cell in row] for row in rows]
        forms: dict[str, tuple[bytes, bool | None]] = {
            "BOM": (b"\xef\xbb\xbf" + _text(rows).encode(), True),
            "semicolons": (_text(rows, ";").encode(), True),
            "decimal commas": (_text([rows[0], *commas[1:]], ";").encode(), True),
            "commas of both kinds": (_text(commas).encode(), False),
            "CRLF": (_text(rows, end="\r\n").encode(), True),
            "CR": (_text(rows, end="\r").encode(), None),
            "tabs": (_text(rows, "\t").encode(), False),
            "quoted": (_text(quoted).encode(), True),
            "spaces": (_text(spaced).encode(), True),
            "UTF-16": (_text(rows).encode("utf-16"), False),
            "empty": (b"", False),
            "header": (_text(rows[:1]).encode(), False),
            "NUL": (_text(rows).encode() + b"\x00", False),
            "open quote": (b'"' + _text(rows).encode(), False),
            "failure": (_text([*rows[:-1], [*rows[-1][:-1], "<script>alert(1)</script>"]]).encode(), None),
            "long failure": (_text([*rows[:-1], [*rows[-1][:-1], "x" * 200_000]]).encode(), None),
        }  # fmt: skip
        name = rng.choice(sorted(forms))
        return name, *forms[name]
    if kind == "scale":
        factor = rng.choice([57.29577951308232, 1000.0, -1.0, 1e9, 2.0])
        for row in rows[1:]:
            row[column] = repr(factor * float(row[column] or 0))
        plausible = column > 0 and abs(factor) < 10  # may be another experiment
        zero = all(float(row[column] or 0) == 0 for row in rows[1:])
        return f"column {column} times {factor:g}", _text(rows).encode(), None if plausible or zero else False
    raw = bytearray(_text(rows).encode())
    for _ in range(rng.choice([1, 3, 30])):
        raw[rng.randrange(len(raw))] = rng.randrange(256)
    return "bytes", bytes(raw), None
