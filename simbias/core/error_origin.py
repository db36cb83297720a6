"""The component in which an error arose, by class and method, to direct its author."""

from __future__ import annotations

import sys
import traceback
from pathlib import Path
from typing import Any

from simbias import core
from simbias.core.errors import ConfigError
from simbias.core.messages import with_type, words

CONTRACTS = (
    *(core.Task, core.Nominal, core.Hardware, core.Policy, core.Samples, core.Cost),
    *(core.Identification, core.Bias, core.FittedBias, core.Evaluation, core.Optimizer),
)
PACKAGE = __name__.partition(".")[0]


def is_own(component: Any) -> bool:
    """Whether a component is the user's own rather than simbias's."""
    return type(component).__module__.partition(".")[0] != PACKAGE


def with_origin(error: BaseException) -> str:
    """The message of an error; if it arose in a user's component, with class, method and the line there."""
    blamed, source, place = None, "", ""
    frames = [*traceback.walk_tb(error.__traceback__)]
    users = [(frame, line) for frame, line in frames if is_users(frame.f_code.co_filename)]
    for frame, line in users or frames:  # a component may also have inherited what raises
        component, code = frame.f_locals.get("self"), frame.f_code
        place = f"{Path(code.co_filename).name}:{line}"
        if isinstance(component, CONTRACTS) and is_own(component) and component is not blamed:
            blamed, source = component, f"{type(component).__name__}.{code.co_name}"
    if not source or isinstance(error, core.HardwareError | ConfigError):
        return words(error) if isinstance(error, ConfigError) else with_type(error)
    return f"{source}: expected a result, got {with_type(error)} ({place})"


def written_at(component: Any, method: str) -> str:
    """File and line of a component's method; the module if these are unknown."""
    code = getattr(getattr(type(component), method), "__code__", None)
    return f"{Path(code.co_filename).name}:{code.co_firstlineno}" if code else type(component).__module__


def has_own_code(error: BaseException) -> bool:
    """Whether an error, or one of its causes, passed through the user's own code."""
    causes = [error]
    while (cause := causes[-1].__cause__) is not None and cause not in causes:
        causes.append(cause)
    frames = (frame for each in causes for frame, _ in traceback.walk_tb(each.__traceback__))
    return any(is_users(frame.f_code.co_filename) for frame in frames)


def is_users(file: str) -> bool:
    """Whether a file belongs neither to simbias nor to Python or an installed library."""
    path = Path(file)
    if not path.is_absolute():  # code without a file
        return False
    roots = (Path(__file__).parent.parent, *map(Path, {sys.base_prefix, sys.prefix}))
    return not any(path.is_relative_to(root) for root in roots)
