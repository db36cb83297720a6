"""Your components keep their contracts: `python -m pytest` in this folder."""

from __future__ import annotations

import pytest

import simbias
from simbias.testing import conformance

CHOICES = ["preset=my_robot", "tracking=none"]


@pytest.mark.parametrize("check", conformance.CHECKS, ids=str)
def test_conformance(check: conformance.Check) -> None:
    """`python -m simbias check` runs the same checks."""
    check.run(simbias.load(CHOICES, "conf"))
