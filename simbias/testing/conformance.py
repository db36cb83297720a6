"""The checks that every component has to pass, whoever wrote it.

In a test of one's own:

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

from simbias.core.error_origin import told
from simbias.core.messages import brief
from simbias.testing import learners, robots, searches, studies  # noqa: F401  they register their checks
from simbias.testing.expectations import CHECKS, Check, ConformanceError
from simbias.trial.study import Study

__all__ = ["CHECKS", "Check", "ConformanceError", "Verdict", "verdicts"]


@dataclass(frozen=True)
class Verdict:
    """How a check went."""

    check: Check
    problem: str  # in one line; empty where there is none
    error: BaseException | None = None  # that it came from


def verdicts(study: Study, groups: Collection[str]) -> Iterator[Verdict]:
    """Run the checks of some groups; what a component raises is a problem too."""
    for check in CHECKS:
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
    """A problem in words, with the name of the component's class."""
    component = type(getattr(study, group)).__name__
    text = told(error)
    if isinstance(error, ConformanceError):
        text = brief(str(error))
        if f"{group}." in text:
            return text.replace(f"{group}.", f"{component}.", 1)
        if re.match(r"\w+(\.\w+)?: ", text):
            return f"{component}.{text.removeprefix(f'{group}: ')}"
    return text if text.startswith(f"{component}.") else f"{component}: {text}"
