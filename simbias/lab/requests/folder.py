"""The folder of a request, with the files that a person in a lab needs."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from simbias.core import HardwareError
from simbias.core.errors import ConfigError
from simbias.lab.checks import START_DEVIATIONS, start_tolerance
from simbias.lab.requests.request import HEADER, MODULE, ExperimentRequest
from simbias.lab.requests.trajectory import template

TRAJECTORY = "trajectory.csv"  # the answer to a request
WITHDRAWN = "withdrawn.txt"  # marks that no trial accepts the answer beside it any more
POLICY, TEMPLATE, README = "policy.json", "template.csv", "README.txt"
GONE = "simbias: %s does not exist, so it is not marked as withdrawn"

TEXT = """\
Run the policy for {duration:g} s ({frames} frames at {rate:g} Hz) from
{start}
Stop at once if
{failures}

Then save the measurements as {trajectory} in this folder, with the columns of {template}: a row for each
frame, {rows} in all, the first at the start. An input is what was commanded from that time on; in the last
row it may be empty. Rows may be more frequent, but not rarer. If the robot failed, end the file with that
row; if none of the limits above describes the failure, name it in that row's column `failure`. If the
controller aborted, end the file with the row in which it did, and write there the name that it gives,
{names}. If a sensor gave no number in that row, leave the row out, and write the name into the one before.
Separate columns by commas, with decimal points in numbers; or by semicolons, with decimal commas or points.

Start the same command again: it resumes with the file, or says in one line what is wrong with it.

{controller}

Abort as soon as one of these no longer holds:
{limits}
"""
CODE = (
    f"The controller is in {HEADER} (C99) and {MODULE} (Python), and aborts beyond the limits below; its "
    f"gains and limits are in {POLICY}, in the units named there."
)
NO_CODE = (
    "This policy cannot be written out as code ({why}). Its parameters are in "
    f"{POLICY}. It runs only in Python, in a hardware class of your own in place of hardware=manual."
)


def write_request(request: ExperimentRequest, folder: Path) -> Path:
    """Write a request's folder among all requests, unless it exists without a withdrawn answer.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    for known in sorted(folder.glob(f"*_{request.name}")):
        if not (known / WITHDRAWN).exists():
            return known
    numbers = [each.name.partition("_")[0] for each in folder.glob("*_*") if each.is_dir()]
    number = 1 + max((int(each) for each in numbers if each.isdecimal()), default=-1)
    own = folder / f"{number:03d}_{request.name}"
    part = folder / f".{own.name}.part"  # so that nobody reads an incomplete request
    part.mkdir(parents=True, exist_ok=True)
    for name, text in files(request).items():
        (part / name).write_text(text, encoding="utf-8")
    part.rename(own)
    return own


def write_controller(request: ExperimentRequest, folder: Path, title: str) -> list[str]:
    """Write a request's controller in C and Python, with gains, units and limits; return the file names.

    Raises
    ------
    ConfigError
        If the policy cannot be written as code.
    OSError
        If the folder cannot be written.
    """
    if request.why_no_code:
        problem = f"cannot be written as code ({request.why_no_code}); load_trial(...).controller() runs it"
        raise ConfigError("policy", problem)
    folder.mkdir(parents=True, exist_ok=True)
    texts = {**request.code(title), POLICY: request.text()}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return list(texts)


def mark_withdrawn(trajectory: Path, words: str) -> None:
    """Mark an answer as withdrawn, so that no trial accepts it again; warn if it no longer exists."""
    if trajectory.exists():
        (trajectory.parent / WITHDRAWN).write_text(f"{words}\n", encoding="utf-8")
    else:
        logging.getLogger(__name__).warning(GONE, trajectory)


def refuse_copied_file(trajectory: Path) -> None:
    """Refuse a copy of the answer to a different request: a HardwareError names the other file."""
    own = trajectory.read_bytes()
    for other in sorted(trajectory.parent.parent.glob(f"*_*/{TRAJECTORY}")):
        if other.read_bytes() == own and _asked(other) != _asked(trajectory):
            raise HardwareError(f"{trajectory}: is the answer to another request, {other}")


def _asked(trajectory: Path) -> dict[str, Any]:
    """The content of a trajectory's request, without its name."""
    return {**json.loads(trajectory.with_name(POLICY).read_text(encoding="utf-8")), "request": ""}


def files(request: ExperimentRequest) -> dict[str, str]:
    """The texts of a request's files by name."""
    law = request.policy.law(request.theta).words
    return {
        POLICY: request.text(),
        TEMPLATE: template(request.task, request.start),
        README: _readme(request),
        **({} if request.why_no_code else request.code(f"Request {request.name}: {law}")),
    }


def _readme(request: ExperimentRequest) -> str:
    """Instructions for a person."""
    task, bounds = request.task, request.bounds
    why = request.why_no_code
    start = zip(task.states, request.start, start_tolerance(task), strict=True)
    targets = f"\nto the targets, which the policy knows,\n{_indented(request.targets)}" * bool(
        request.targets
    )
    failures = [f"{each.words} ({each.name} above {each.limit:g} {each.unit})" for each in task.criteria]
    limits = [
        *(
            (f"|{q.name}|" if lower == -upper else f"{lower:g} <= {q.name}", upper, q.unit)
            for q, lower, upper in zip(task.inputs, *bounds.input_bounds, strict=True)
        ),
        *(
            (f"|change of {q.name}|", v, f"{q.unit} per s")
            for q, v in zip(task.inputs, bounds.input_rates, strict=True)
        ),
        *((f"|{q.name}|", v, q.unit) for q, v in zip(task.states, bounds.states, strict=True)),
    ]
    return TEXT.format(
        duration=task.horizon * task.time_step,
        frames=task.horizon,
        rows=task.horizon + 1,
        rate=1 / task.time_step,
        start=_indented(f"{q.name} = {x:g} {q.unit}{_within(d)}" for q, x, d in start) + targets,
        names=f"such as unsafe_rate_of_{task.inputs[0].name}",
        failures=_indented(failures or ["continuing is not safe"]),
        trajectory=TRAJECTORY,
        template=TEMPLATE,
        controller=fill(NO_CODE.format(why=why) if why else CODE, 110),
        limits=_indented(
            [
                *(f"{name} <= {v:g} {unit}" for name, v, unit in limits if np.isfinite(v)),
                *(["no failure above"] if bounds.criteria else []),
            ]
        ),
    )


def _within(tolerance: float) -> str:
    """The tolerance of a start in words."""
    if not np.isfinite(tolerance):
        return ""
    off = f"off by more than {tolerance:.3g}, {START_DEVIATIONS:g} deviations of the task's starts"
    return f" (refused if it is {off})"


def _indented(lines: Iterable[str]) -> str:
    return "\n".join(f"  {line}" for line in lines)
