"""Every promise of tests/README.md names a test that is there."""

from __future__ import annotations

import re

from conftest import ROOT

README = (ROOT / "tests" / "README.md").read_text()
PROMISES = re.findall(r"^\| (.+) \| `(tests/[\w/]+\.py)::(\w+)` \|$", README, re.MULTILINE)


def test_every_promise_has_its_test() -> None:
    rows = [line for line in README.splitlines() if line.startswith("| ") and "---" not in line]
    assert len(PROMISES) == len([row for row in rows if row != "| promise | test |"])
    for _, file, test in PROMISES:
        assert re.search(rf"^def {test}\(", (ROOT / file).read_text(), re.MULTILINE), test
