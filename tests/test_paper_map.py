"""The map from the paper to functions and tests is true."""

from __future__ import annotations

import importlib
import re
from functools import reduce

from conftest import ROOT

README = (ROOT / "simbias" / "README.md").read_text()
ROWS = re.findall(
    r"^\| ([^|]+) \| `(simbias[\w.]+)` \| `(tests/[\w/]+\.py)::(\w+)` \|$", README, re.MULTILINE
)


def located(path: str):
    """The object at a dotted path of modules, classes and methods."""
    parts = path.split(".")
    for length in range(len(parts), 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        return reduce(getattr, parts[length:], module)
    raise AssertionError(f"{path} does not exist")


def equations(text: str) -> set[int]:
    """Numbers in mentions such as `Eq. 4`, `Eq. 3, 5` and `Eq. 3-7`."""
    numbers = set()
    for mention in re.findall(r"Eq\. (\d+(?:(?:, |-)\d+)*)", text):
        for part in mention.split(", "):
            first, _, last = part.partition("-")
            numbers |= set(range(int(first), int(last or first) + 1))
    return numbers


def test_every_equation_is_in_the_map() -> None:
    papers = [paper for paper, *_ in ROWS]
    assert set().union(*map(equations, papers)) == set(range(1, 11))
    assert "Algorithm 1" in papers


def test_rows_are_true() -> None:
    """The code exists, its docstring names the equation, and the test exists."""
    for paper, code, file, test in ROWS:
        assert equations(paper) <= equations(located(code).__doc__), code
        assert re.search(rf"^def {test}\(", (ROOT / file).read_text(), re.MULTILINE), test
