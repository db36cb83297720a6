"""What every component has to pass, whoever wrote it.

In a test of one's own:

    @pytest.mark.parametrize("check", conformance.CHECKS, ids=str)
    def test_my_robot(check):
        check.run(simbias.load(["nominal=mine", "hardware=mine"], "my_conf"))

On the command line: `python -m simbias check nominal=mine hardware=mine --config-dir my_conf`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

from simbias.study import Study
from simbias.testing import learners, robots, searches  # noqa: F401  they register their checks
from simbias.testing.check import CHECKS, Check
from simbias.testing.expectations import ConformanceError

__all__ = ["CHECKS", "Check", "ConformanceError", "Verdict", "verdicts"]


@dataclass(frozen=True)
class Verdict:
    """How a check went."""

    check: Check
    problem: str  # in one line; empty where there is none


def verdicts(study: Study, groups: Collection[str]) -> Iterator[Verdict]:
    """Run the checks of some groups; what a component raises is a problem too."""
    for check in CHECKS:
        if check.group in groups:
            try:
                check.run(study)
            except Exception as error:
                name = "" if isinstance(error, ConformanceError) else f"{type(error).__name__}: "
                yield Verdict(check, name + " ".join(str(error).split())[:300])
            else:
                yield Verdict(check, "")
