"""The checks that every component has to pass, including custom ones.

In a custom test:

    @pytest.mark.parametrize("check", conformance.CHECKS, ids=str)
    def test_my_robot(check):
        check.run(simbias.load(["nominal=mine", "hardware=mine"], "my_conf"))

On the command line: `python -m simbias check nominal=mine hardware=mine --config-dir my_conf`.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from simbias.core.error_origin import with_origin
from simbias.core.messages import brief
from simbias.testing import learners, robots, searches, studies  # noqa: F401  (they register their checks)
from simbias.testing.expectations import CHECKS, Check, ConformanceError
from simbias.trial.study import Study

__all__ = ["CHECKS", "Check", "ConformanceError", "Verdict", "verdicts"]


@dataclass(frozen=True)
class Verdict:
    """The result of a check."""

    check: Check
    problem: str  # in one line; empty if there is none
    error: BaseException | None = None  # its cause


def verdicts(study: Study, groups: Collection[str], checks: Collection[Check] = CHECKS) -> Iterator[Verdict]:
    """Run the checks of some groups; an error raised by a component is also a problem."""
    for check in checks:
        if check.group in groups:
            try:
                with threadpool_limits(1, user_api="blas"):  # as in a trial
                    check.run(study)
            except KeyboardInterrupt:
                raise
            except BaseException as error:  # also SystemExit
                yield Verdict(check, _problem(study, check.group, error), error)
            else:
                yield Verdict(check, "")


def _problem(study: Study, group: str, error: BaseException) -> str:
    """An error as a problem in words, with the name of the component's class."""
    component = type(getattr(study, group)).__name__
    text = with_origin(error)
    if isinstance(error, ConformanceError):
        text = brief(str(error))
        if f"{group}." in text:
            return text.replace(f"{group}.", f"{component}.", 1)
        if re.match(r"\w+(\.\w+)?: ", text):
            return f"{component}.{text.removeprefix(f'{group}: ')}"
    return text if text.startswith(f"{component}.") else f"{component}: {text}"
