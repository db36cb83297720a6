"""The component in which an error arose, by class and method, so that its author knows where to look."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from simbias import core
from simbias.core.messages import with_type

CONTRACTS = (
    *(core.Task, core.Nominal, core.Hardware, core.Policy, core.Samples, core.Cost),
    *(core.Identification, core.Bias, core.FittedBias, core.Evaluation, core.Optimizer),
)
PACKAGE = __name__.partition(".")[0]


def is_own(component: Any) -> bool:
    """Whether a component is the user's own, and none of simbias's."""
    return type(component).__module__.partition(".")[0] != PACKAGE


def raised_by(error: BaseException) -> str:
    """`Class.method` of the user's component in which an error arose; "" if it arose in none."""
    blamed, name = None, ""
    for frame in _frames(error):
        component = frame.f_locals.get("self")
        if isinstance(component, CONTRACTS) and is_own(component) and component is not blamed:
            blamed, name = component, f"{type(component).__name__}.{frame.f_code.co_name}"
    return name


def told(error: BaseException) -> str:
    """The message of an error, with the component in which it arose if that is the user's."""
    source = raised_by(error)
    if not source or isinstance(error, core.HardwareError):
        return with_type(error)
    *_, (frame, line) = traceback.walk_tb(error.__traceback__)
    place = f"{Path(frame.f_code.co_filename).name}:{line}"
    return f"{source}: expected a result, got {with_type(error)} ({place})"


def written_at(component: Any, method: str) -> str:
    """File and line of a component's method; its module if that is not known."""
    code = getattr(getattr(type(component), method), "__code__", None)
    return f"{Path(code.co_filename).name}:{code.co_firstlineno}" if code else type(component).__module__


def has_own_code(error: BaseException) -> bool:
    """Whether an error, or one that it came from, passed through code that is no installed library's."""
    causes = [error]
    while (cause := causes[-1].__cause__) is not None and cause not in causes:
        causes.append(cause)
    return any(is_users(frame.f_code.co_filename) for each in causes for frame in _frames(each))


def is_users(file: str) -> bool:
    """Whether a file belongs neither to simbias nor to Python or an installed library."""
    path = Path(file)
    if not path.is_absolute():  # code without a file
        return False
    roots = (Path(__file__).parent.parent, *map(Path, {sys.base_prefix, sys.prefix}))
    return not any(path.is_relative_to(root) for root in roots)


def _frames(error: BaseException) -> Iterator[FrameType]:
    """The frames that an error passed through, the outermost first."""
    return (frame for frame, _ in traceback.walk_tb(error.__traceback__))
