"""A policy's law as a C header and as a Python module, for control loops without simbias.

Both are generated from the trace of `Policy.act`, and keep track of policy state and time.
"""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import indent

import numpy as np

from simbias.core import Quantity, Task
from simbias.core.records import Array
from simbias.core.robot import NOT_A_NUMBER
from simbias.lab.safety import Bounds
from simbias.simulation.compiler import NUMPY, C, Formulas

BEYOND = "failed"  # the failure beyond a criterion, where inputs are nan (`act_within_criteria`)
HARMLESS = " .,:;+-*/^%()[]<>=|_'°"  # characters besides letters and digits in comments of generated code

HEADER = """\
/* {title}
 *
 * Call simbias_start before an experiment, then simbias_control once a frame, every {time_step!r} s.
 *   x: {states}
 *   u: {inputs}
 * It returns 0, or 1 if a limit is exceeded or a value is not a number: then abort the experiment. Until
 * simbias_start is called again, u is then zero, controller->failure names the limit, and it returns 1.
 */
#ifndef SIMBIAS_CONTROLLER_H
#define SIMBIAS_CONTROLLER_H
#include <math.h>

#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "compile without -ffast-math, which cannot detect what is not a number"
#endif

#define SIMBIAS_TIME_STEP {time_step!r} /* s */

typedef struct {{
    long frame;
    const char *failure; /* the limit that ended the experiment; 0 as long as there is none */
    double u[{m}]; /* in the previous frame */
{state_field}}} simbias_controller;

static inline void simbias_start(simbias_controller *controller)
{{
    static simbias_controller start; /* zero, as it is static */
    *controller = start;
}}
{functions}
static inline int simbias_control(simbias_controller *controller, const double x[{n}], double u[{m}])
{{
{constants}{locals}{body}    const char *failure = controller->failure;
    for (int i = 0; !failure && i < {n}; ++i)
        if (!(fabs(x[i]) <= STATE_LIMIT[i]))
            failure = STATE_FAILURE[i];
{criteria_check}    for (int i = 0; !failure && i < {m}; ++i)
        if (!(u[i] >= INPUT_LOWER[i] && u[i] <= INPUT_UPPER[i]))
            failure = INPUT_FAILURE[i];
    for (int i = 0; !failure && controller->frame && i < {m}; ++i)
        if (!(fabs(u[i] - controller->u[i]) <= INPUT_CHANGE[i]))
            failure = CHANGE_FAILURE[i];
{state_check}    controller->failure = failure;
    for (int i = 0; i < {m}; ++i)
        controller->u[i] = u[i] = failure ? 0.0 : u[i];
    if (failure)
        return 1;
{state_update}    ++controller->frame;
    return 0;
}}

#endif
"""
INTERPOLATED = """
static inline double simbias_interpolated(double position, int rows, const double *column)
{
    const int reached = position < rows - 1 ? (int)position : rows - 2;
    const int row = reached < rows - 1 ? reached : rows - 2; /* (int)position may be rounded up to rows - 1 */
    const double share = position - row < 1.0 ? position - row : 1.0;
    return column[row] + share * (column[row + 1] - column[row]);
}
"""
CRITERIA_CHECK = """\
    for (int i = 0; !failure && i < {m}; ++i)
        if (isnan(u[i]))
            failure = {beyond};
"""
STATE_CHECK = """\
    for (int i = 0; !failure && i < {s}; ++i)
        if (!isfinite(next[i]))
            failure = {no_number};
"""
STATE_UPDATE = """\
    for (int i = 0; i < {s}; ++i)
        controller->policy_state[i] = next[i];
"""

MODULE = '''\
"""{title}

Make a Controller for each experiment, and call it once a frame, every {time_step!r} s: u = controller(x).
  x: {states}
  u: {inputs}
It raises ValueError if a limit is exceeded or a value is not a number, and in every later call: then abort
the experiment. Its `failure` names the limit.
"""

import numpy as np

TIME_STEP = {time_step!r}  # s
{constants}

def law(x, t, policy_state):
    """Inputs u ({m},), and the policy state ({s},) for the next frame."""
{body}    return np.array([{u}]), np.array([{policy_state}])


class Controller:
    """The inputs u ({m},) at states x ({n},), frame by frame."""

    def __init__(self):
        self.frame, self.failure = 0, ""
        self.u, self.policy_state = np.zeros({m}), np.zeros({s})

    def __call__(self, x):
        before, self.failure = self.failure, self.failure or {no_number}  # also if an error is raised here
        x = np.asarray(x, dtype=float).reshape({n})
        with np.errstate(all="ignore"):
            u, policy_state = law(x, self.frame * TIME_STEP, self.policy_state)
            safe = [
                *zip(STATE_FAILURE, np.abs(x) <= STATE_LIMIT),
{criteria_check}                *zip(INPUT_FAILURE, (INPUT_LOWER <= u) & (u <= INPUT_UPPER)),
                *zip(CHANGE_FAILURE, (np.abs(u - self.u) <= INPUT_CHANGE) | (self.frame == 0)),
                ({no_number}, np.isfinite(policy_state).all()),
            ]
        self.failure = before or next((failure for failure, fine in safe if not fine), "")
        if self.failure:
            raise ValueError(f"abort: {{self.failure}}: x = {{x}}, u = {{u}}")
        self.frame, self.u, self.policy_state = self.frame + 1, u, policy_state
        return u
'''


def c_header(task: Task, law: Formulas, title: str, bounds: Bounds) -> str:
    """The law as a C99 header."""
    lines, u, policy_state = law.written(C)
    lines += [f"u[{i}] = {value};" for i, value in enumerate(u)]
    lines += [f"next[{i}] = {value};" for i, value in enumerate(policy_state)]
    s = len(policy_state)
    before = ["const double t = (double)controller->frame * SIMBIAS_TIME_STEP;"] * law.time_dependent
    before += ["const double *policy_state = controller->policy_state;", f"double next[{s}];"] * (s > 0)
    constants = [
        f"static const double {name}[{len(values)}] = {{{', '.join(map(C.number, values.tolist()))}}};"
        for name, values in _limits(task, bounds).items()
    ]
    constants += [
        f"static const char *const {name}[{len(names)}] = {{{', '.join(map(_quoted, names))}}};"
        for name, names in _failures(task).items()
    ]
    return HEADER.format(
        **_words(task, title),
        state_field=f"    double policy_state[{s}];\n" if s else "",
        functions=INTERPOLATED if law.looks_up else "",
        constants=_indented(constants),
        locals=_indented(before),
        body=_indented(lines),
        criteria_check=CRITERIA_CHECK.format(m=len(u), beyond=_quoted(BEYOND)) if bounds.criteria else "",
        state_check=STATE_CHECK.format(s=s, no_number=_quoted(NOT_A_NUMBER)) if s else "",
        state_update=STATE_UPDATE.format(s=s) if s else "",
    )


def python_module(task: Task, law: Formulas, title: str, bounds: Bounds) -> str:
    """The law as a Python module with NumPy."""
    lines, u, policy_state = law.written(NUMPY)
    constants = [f"{name} = {values.tolist()!r}\n" for name, values in _limits(task, bounds).items()]
    for name, names in _failures(task).items():
        constants.append(f"{name} = [{', '.join(map(_quoted, names))}]\n")
    check = f"                ({_quoted(BEYOND)}, not np.isnan(u).any()),\n"
    return MODULE.format(
        **_words(task, title),
        constants="".join(constants),
        criteria_check=check if bounds.criteria else "",
        no_number=_quoted(NOT_A_NUMBER),
        s=len(policy_state),
        body=_indented(lines),
        u=", ".join(u),
        policy_state=", ".join(policy_state),
    )


def harmless(words: str) -> str:
    """Text from a config, made unable to end a comment, string or line in generated code."""
    kept = "".join(each if each.isalnum() or each in HARMLESS else " " for each in words)
    return kept.replace("*/", "* /").replace("/*", "/ *")


def _limits(task: Task, bounds: Bounds) -> dict[str, Array]:
    """Limits by name; a missing limit becomes the largest finite number."""
    largest = np.finfo(np.float64).max
    lower, upper = bounds.input_bounds
    return {
        "STATE_LIMIT": np.fmin(bounds.states, largest),
        "INPUT_LOWER": np.fmax(lower, -largest),
        "INPUT_UPPER": np.fmin(upper, largest),
        "INPUT_CHANGE": np.fmin(bounds.input_rates * task.time_step, largest),
    }


def _failures(task: Task) -> dict[str, list[str]]:
    """Names of the limits, as in experiments aborted by simbias, without harmful characters."""
    return {
        "STATE_FAILURE": [f"unsafe_state_{state.name}" for state in task.states],
        "INPUT_FAILURE": [f"unsafe_input_{each.name}" for each in task.inputs],
        "CHANGE_FAILURE": [f"unsafe_rate_of_{each.name}" for each in task.inputs],
    }


def _quoted(name: str) -> str:
    """A name as a string literal in generated code."""
    return f'"{harmless(name)}"'


def _words(task: Task, title: str) -> dict[str, object]:
    """Template values shared by both languages."""
    return {
        "title": harmless(title),
        "time_step": float(task.time_step),
        "states": _list(task.states),
        "inputs": _list(task.inputs),
        "n": len(task.states),
        "m": len(task.inputs),
    }


def _list(quantities: Sequence[Quantity]) -> str:
    return ", ".join(harmless(f"{quantity.name} ({quantity.unit})") for quantity in quantities)


def _indented(lines: Sequence[str]) -> str:
    return indent("".join(f"{line}\n" for line in lines), "    ")
