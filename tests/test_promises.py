"""Every promise of tests/README.md names a test that is there; the map from the paper to the code is true."""

import importlib
import re
from functools import reduce

from conftest import ROOT

PROMISES, MAP = ((ROOT / folder / "README.md").read_text() for folder in ("tests", "simbias"))
TEST = r"`(tests/[\w/]+\.py)::(\w+)` \|$"
PROMISED = re.findall(rf"^\| .+ \| {TEST}", PROMISES, re.MULTILINE)
MAPPED = re.findall(rf"^\| ([^|]+) \| `(simbias[\w.]+)` \| {TEST}", MAP, re.MULTILINE)


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


def test_every_test_that_is_named_is_there() -> None:
    rows = [line for line in PROMISES.splitlines() if line.startswith("| ") and "---" not in line]
    assert len(PROMISED) == len([row for row in rows if row != "| promise | test |"])
    for file, test in [*PROMISED, *(row[2:] for row in MAPPED)]:
        assert re.search(rf"^def {test}\(", (ROOT / file).read_text(), re.MULTILINE), test


def test_every_equation_is_in_the_map_and_named_by_its_code() -> None:
    papers = [paper for paper, *_ in MAPPED]
    assert set().union(*map(equations, papers)) == set(range(1, 11))
    assert "Algorithm 1" in papers
    for paper, code, *_ in MAPPED:
        assert equations(paper) <= equations(located(code).__doc__), code
