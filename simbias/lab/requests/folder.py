"""The folder of an order: what a person in a lab needs, in files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import numpy as np

from simbias.lab.requests.controller import c_header, derive, python_module
from simbias.lab.requests.order import Order
from simbias.lab.requests.symbols import UntraceableError
from simbias.lab.requests.trajectory import template

TRAJECTORY = "trajectory.csv"  # what is waited for
POLICY, TEMPLATE, README = "policy.json", "template.csv", "README.txt"
HEADER, MODULE = "controller.h", "controller.py"

SENTENCE = """\
Run the policy for {duration:g} s ({frames} frames at {rate:g} Hz) from
{start}
Stop at once if
{failures}

Then save what was measured as {trajectory} in this folder, with the columns of {template}: a row for each
frame, {rows} in all, the first at the start. An input is what was commanded from that time on; in the last
row it may be empty. Rows may be more frequent, not rarer. If the robot failed, end the file with that row; if
none of the limits above tells how, name it in that row's column `failure`.

Start the same command again: it goes on with the file, or says in one line what is wrong with it.

{controller}

{limits}"""
CODE = (
    f"The controller is in {HEADER} (C99) and {MODULE} (Python); its gains and limits are in {POLICY}, in "
    "the units named there."
)
NO_CODE = (
    "This policy cannot be written out as code ({why}). Its parameters are in "
    f"{POLICY}; run it by `study.policy.controller(parameters, time_step)`."
)


def write_order(order: Order, orders: Path) -> Path:
    """The folder of an order among those of others, written unless it is there.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    known = sorted(orders.glob(f"*_{order.name}"))
    if known:
        return known[0]
    number = sum(1 for each in orders.glob("*_*") if each.is_dir())
    folder = orders / f"{number:03d}_{order.name}"
    part = orders / f".{folder.name}.part"  # so that no half of an order is ever taken for one
    part.mkdir(parents=True, exist_ok=True)
    for name, text in files(order).items():
        (part / name).write_text(text, encoding="utf-8")
    part.rename(folder)
    return folder


def files(order: Order) -> dict[str, str]:
    """The files of an order by name."""
    title = f"Order {order.name}: {order.policy.law(order.theta).words}"
    code: dict[str, str] = {}
    try:
        law = derive(order.task, order.policy, order.theta)
        code = {
            HEADER: c_header(order.task, law, title, order.bounds),
            MODULE: python_module(order.task, law, title, order.bounds),
        }
        controller = CODE
    except UntraceableError as error:
        controller = NO_CODE.format(why=error)
    return {
        POLICY: order.text(),
        TEMPLATE: template(order.task, order.start),
        README: _readme(order, controller),
        **code,
    }


def _readme(order: Order, controller: str) -> str:
    """What to do, in words."""
    task = order.task
    start = [f"{q.name} = {x:g} {q.unit}" for q, x in zip(task.states, order.start, strict=True)]
    failures = [f"{each.words} ({each.name} above {each.limit:g} {each.unit})" for each in task.criteria]
    return SENTENCE.format(
        duration=task.horizon * task.time_step,
        frames=task.horizon,
        rows=task.horizon + 1,
        rate=1 / task.time_step,
        start=_indented(start),
        failures=_indented(failures or ["it is not safe to go on"]),
        trajectory=TRAJECTORY,
        template=TEMPLATE,
        controller=fill(controller, 110),
        limits=_limits(order),
    )


def _limits(order: Order) -> str:
    """The limits that the lab has to hold, a line each."""
    task, bounds = order.task, order.bounds
    lines = [
        *(f"|{q.name}| <= {v:g} {q.unit}" for q, v in zip(task.inputs, bounds.inputs, strict=True)),
        *(
            f"|change of {q.name}| <= {v:g} {q.unit} per s"
            for q, v in zip(task.inputs, bounds.input_rates, strict=True)
        ),
        *(f"|{q.name}| <= {v:g} {q.unit}" for q, v in zip(task.states, bounds.states, strict=True)),
    ]
    finite = [line for line in lines if "<= inf" not in line]
    held = " (the code above holds all but the changes)" if np.isfinite(bounds.input_rates).any() else ""
    return f"Abort beyond any of these limits{held}:\n{_indented(finite)}\n"


def _indented(lines: Sequence[str]) -> str:
    """Lines of a list."""
    return "\n".join(f"  {line}" for line in lines)
