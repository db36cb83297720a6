"""Does a test fail where an equation is changed by one operator, comparison or number?

`python sweeps/studies/mutants.py OUT.csv --of simbias/learning/bias/gp.py ... --tests tests/bias ...` runs
tests for each mutant, the quick ones first, up to the first that fails, and writes a row for each: killed,
late (the tests take too long), or alive. `--share 0.1` draws a tenth of the mutants, by the seed.

Operators are cosmic-ray's, one or two for each place: + and -, * and /, ** and @ to *, comparisons at their
limit and turned round, conditions negated, signs dropped, `and` and `or`, numbers by one (floats doubled,
too), minima and maxima, sines and cosines. Text, annotations, defaults, and what raises errors stay.

Each mutant runs in a fork, in which everything but what depends on it is imported already.
"""

from __future__ import annotations

import argparse
import ast
import copy
import gc
import importlib
import importlib.abc
import importlib.util
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

import pandas as pd

ROOT = Path(__file__).resolve().parents[2]
BINARY = {"Add": "Sub", "Sub": "Add", "Mult": "Div", "Div": "Mult", "FloorDiv": "Div", "Mod": "FloorDiv"}
BINARY |= {"Pow": "Mult", "MatMult": "Mult", "BitAnd": "BitOr", "BitOr": "BitAnd"}
COMPARISONS = {"Lt": ["LtE", "GtE"], "LtE": ["Lt", "Gt"], "Gt": ["GtE", "LtE"], "GtE": ["Gt", "Lt"]}
COMPARISONS |= {"Eq": ["NotEq"], "NotEq": ["Eq"], "Is": ["IsNot"], "IsNot": ["Is"], "In": ["NotIn"]}
COMPARISONS |= {"NotIn": ["In"]}
NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "sin": "cos", "cos": "sin"}
IMPORTED = ["hypothesis", "hydra", "joblib", "matplotlib", "mlflow", "nlopt", "numba", "numpy", "omegaconf"]
IMPORTED += [
    "pandas",
    "pydantic",
    "pymunk",
    "pytest",
    "rich",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.stats",
]


def replacements(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """What a node may be instead, and in words."""
    if isinstance(node, ast.BinOp | ast.AugAssign):
        if (name := type(node.op).__name__) in BINARY:
            yield f"{name} to {BINARY[name]}", _with(node, op=getattr(ast, BINARY[name])())
    elif isinstance(node, ast.Compare):
        for i, each in enumerate(node.ops):
            for other in COMPARISONS[type(each).__name__]:
                changed = [*node.ops[:i], getattr(ast, other)(), *node.ops[i + 1 :]]
                yield f"{type(each).__name__} to {other}", _with(node, ops=changed)
    elif isinstance(node, ast.BoolOp):
        operator = ast.Or if isinstance(node.op, ast.And) else ast.And
        yield f"{type(node.op).__name__} to {operator.__name__}", _with(node, op=operator())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
        yield f"no {type(node.op).__name__}", node.operand
    elif isinstance(node, ast.If | ast.IfExp | ast.While) and not isinstance(node.test, ast.Compare):
        yield "condition negated", _with(node, test=ast.UnaryOp(ast.Not(), node.test))
    elif isinstance(node, ast.Constant) and type(node.value) in (bool, int, float):
        value = node.value
        others = [not value] if isinstance(value, bool) else [value + 1, value - 1]
        others = [value + 1.0, 2.0 * value] if isinstance(value, float) else others
        for other in others:
            if other != value:
                yield f"{value} to {other}", ast.Constant(other)
    elif isinstance(node, ast.Name) and node.id in NAMES:
        yield f"{node.id} to {NAMES[node.id]}", _with(node, id=NAMES[node.id])
    elif isinstance(node, ast.Attribute) and node.attr in NAMES:
        yield f"{node.attr} to {NAMES[node.attr]}", _with(node, attr=NAMES[node.attr])


def _with(node: ast.AST, **fields: object) -> ast.AST:
    """A node with other fields."""
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def places(node: ast.AST) -> Iterator[tuple[ast.AST, str, int | None, ast.AST]]:
    """The parts of a tree that may be mutated: parent, field, index and node."""
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "defaults", "kw_defaults"):
            continue
        for index, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if isinstance(child, ast.AST) and not isinstance(
                child, ast.Raise | ast.JoinedStr | ast.AnnAssign
            ):
                yield node, field, index, child
                yield from places(child)


def mutants(source: str) -> Iterator[tuple[int, str, str, ast.Module]]:
    """Of a module: line, change, the line's new text, and the changed tree."""
    tree = ast.parse(source)
    for parent, field, index, node in places(tree):
        for change, other in replacements(node):
            before = getattr(parent, field)
            ast.copy_location(other, node)
            setattr(
                parent, field, [*before[:index], other, *before[index + 1 :]] if index is not None else other
            )
            text = ast.unparse(other).splitlines()[0]
            yield node.lineno, change, text, ast.fix_missing_locations(copy.deepcopy(tree))  # type: ignore[attr-defined]
            setattr(parent, field, before)


@cache
def imports() -> dict[str, set[str]]:
    """The modules of simbias, and the names that each imports."""
    found = {}
    for file in (ROOT / "simbias").rglob("*.py"):
        parts = file.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        nodes = list(ast.walk(ast.parse(file.read_text())))
        plain = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
        froms = [node for node in nodes if isinstance(node, ast.ImportFrom)]
        found[name] = plain | {f"{node.module}.{alias.name}" for node in froms for alias in node.names}
        found[name] |= {str(node.module) for node in froms}
    return found


@cache
def dependents(name: str) -> set[str]:
    """A module and those that import it, or one that does."""
    found, before = {name}, set()
    while found != before:
        before = set(found)
        found |= {module for module, names in imports().items() if names & before}
    return found


class Mutated(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds one module as a mutant of itself."""

    def __init__(self, name: str, file: Path, tree: ast.Module) -> None:
        self._name, self._file, self._tree = name, file, tree
        self.anew = dependents(name)  # modules to be imported anew

    def find_spec(self, name, path, target=None):
        return (
            importlib.util.spec_from_file_location(name, self._file, loader=self)
            if name == self._name
            else None
        )

    def create_module(self, spec) -> None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        exec(compile(self._tree, self._file, "exec"), vars(module))


class Quickest:
    """Puts tests in order by how long they took, and notes how long they take."""

    def __init__(self, known: dict[str, float], seconds: float) -> None:
        self.took: dict[str, float] = {}
        self._known, self._most = known, seconds

    def pytest_collection_modifyitems(self, items: list) -> None:
        items[:] = [item for item in items if self._known.get(item.nodeid, 0.0) <= self._most]
        items.sort(key=lambda item: self._known.get(item.nodeid, 0.0))

    def pytest_runtest_logreport(self, report) -> None:
        self.took[report.nodeid] = self.took.get(report.nodeid, 0.0) + report.duration

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        print(f"took {self.took[nodeid]:.3f} {nodeid}", flush=True)


def run(tests: list[str], plugin: Quickest, finder: Mutated | None, seconds: float, log: Path) -> int | None:
    """The exit status of the tests in a process of their own; None where they take too long."""
    child = os.fork()
    if not child:
        os.setsid()
        for number in (1, 2):
            os.dup2(os.open(log, os.O_CREAT | os.O_WRONLY | os.O_APPEND), number)
        if finder:
            sys.meta_path.insert(0, finder)
            for name in finder.anew:
                sys.modules.pop(name, None)
        import hypothesis
        import pytest

        quick = [hypothesis.Phase.explicit, hypothesis.Phase.generate]
        hypothesis.settings.register_profile("mutants", phases=quick, derandomize=True, database=None)
        hypothesis.settings.load_profile("mutants")
        options = [
            "-x",
            "-q",
            "-p",
            "no:cacheprovider",
            "-p",
            "no:unraisableexception",
            "-o",
            "addopts=--import-mode=importlib",
            "--rootdir",
            str(ROOT),
            "--tb=line",
        ]
        os._exit(int(pytest.main([*options, *tests], plugins=[plugin])))
    began = time.monotonic()
    while time.monotonic() - began < seconds:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def main() -> None:
    """Try all mutants of the files with the tests."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--of", nargs="+", type=Path, required=True)
    parser.add_argument("--tests", nargs="+", required=True)
    parser.add_argument("--share", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--longest", type=float, default=10.0, help="s that a single test may take")
    parser.add_argument("--count", action="store_true", help="only count the mutants")
    parsed = parser.parse_args()
    os.environ |= {
        "OPENBLAS_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
    }
    rng = random.Random(parsed.seed)
    todo = [
        (file, *mutant)
        for file in parsed.of
        for mutant in mutants(file.read_text())
        if rng.random() < parsed.share
    ]
    print(f"{len(todo)} mutants", flush=True)
    if parsed.count:
        return
    sys.path[:0] = [
        str(ROOT),
        str(ROOT / "tests"),
        str(ROOT / "tests" / "support"),
        str(ROOT / "notebooks" / "examples"),
    ]
    for name in [
        *IMPORTED,
        "simbias.config.build",
        "simbias.trial.study",
        "simbias.testing.conformance",
    ]:
        importlib.import_module(name)
    gc.freeze()
    rows = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        os.environ["NUMBA_CACHE_DIR"] = folder
        log = Path(folder, "log")
        began = time.monotonic()
        for _ in range(2):  # the second time all is compiled
            log.unlink(missing_ok=True)
            assert run(parsed.tests, Quickest({}, 1e9), None, 3600.0, log) == 0, log.read_text()
        known = {
            words[2]: float(words[1])
            for words in (
                line[line.find("took ") :].split(maxsplit=2)
                for line in log.read_text().splitlines()
                if "took " in line
            )
        }
        most = 60.0 + 10.0 * sum(each for each in known.values() if each <= parsed.longest)
        print(f"{len(known)} tests, {time.monotonic() - began:.0f} s", flush=True)
        for file, line, change, text, tree in todo:
            name = ".".join(file.resolve().relative_to(ROOT).with_suffix("").parts)
            log.unlink(missing_ok=True)
            began = time.monotonic()
            status = run(parsed.tests, Quickest(known, parsed.longest), Mutated(name, file, tree), most, log)
            verdict = "late" if status is None else "alive" if status == 0 else "killed"
            rows.append((str(file), line, change, text, verdict, round(time.monotonic() - began, 2)))
            if verdict == "alive":
                print(*rows[-1], flush=True)
            if len(rows) % 20 == 0:
                _write(rows, parsed.out)
    _write(rows, parsed.out)
    print(pd.read_csv(parsed.out).groupby(["file", "verdict"]).size().unstack(fill_value=0).to_string())


def _write(rows: list, out: Path) -> None:
    columns = ["file", "line", "change", "text", "verdict", "seconds"]
    pd.DataFrame(rows, columns=columns).to_csv(out, index=False)


if __name__ == "__main__":
    main()
