"""The package as text: it uses what others promise to keep and pyproject declares; docstrings are plain."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import packages_distributions

from conftest import ROOT

PACKAGE = ROOT / "simbias"
# Numba documents some of its modules by these names.
DOCUMENTED = ("numba.core.cgutils", "numba.core.errors", "numba.core.event", "numba.core.types")
PRIVATE = re.compile(r"\._[a-z]|\.externals\b|^numba\.core\b")


@cache
def trees() -> dict[str, ast.Module]:
    """The package's modules by their files; not at import, as each of the tests' processes imports this."""
    return {
        file.relative_to(PACKAGE).as_posix(): ast.parse(file.read_text())
        for file in sorted(PACKAGE.rglob("*.py"))
        if not {"__pycache__", "templates"} & set(file.parts)
    }


def imports(tree: ast.Module) -> set[str]:
    """Modules and names in full, of other packages."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in names if name.split(".")[0] not in (*sys.stdlib_module_names, "simbias")}


def own_names(tree: ast.Module) -> Iterator[str]:
    """The names that a module defines, also on instances."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr


def attributes(tree: ast.Module) -> Iterator[str]:
    """The attributes of others that a module reads, or asks for by name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) not in ("self", "cls"):
            yield node.attr
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("getattr", "hasattr"):
            yield ast.literal_eval(node.args[1]) if isinstance(node.args[1], ast.Constant) else ""


def test_no_private_parts() -> None:
    """Nor does a module use those of another one."""
    found = {}
    for file, tree in trees().items():
        own = {"_asdict", "_exit", "_fields", "_make", "_replace", *own_names(tree)}  # Python documents these
        private = {name for name in imports(tree) if PRIVATE.search(name) and not name.startswith(DOCUMENTED)}
        private |= {name for name in attributes(tree) if re.match("_[a-z]", name) and name not in own}
        if private:
            found[file] = private
    assert not found


def test_what_is_imported_is_declared() -> None:
    """And what every user installs is imported."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    always = set(map(name_of, project["dependencies"]))
    extras = {name_of(line) for lines in project["optional-dependencies"].values() for line in lines}
    packages = packages_distributions()
    modules = {name.split(".")[0] for tree in trees().values() for name in imports(tree)}
    needed = {module: {name_of(each) for each in packages.get(module, [module])} for module in modules}
    assert {module for module, names in needed.items() if not names & (always | extras)} == set()
    assert always - set().union(*needed.values()) == set()


def name_of(requirement: str) -> str:
    """The name of a package, as registries compare it."""
    return re.split(r"[\[<>=;, ]", requirement)[0].lower().replace("_", "-")


def test_no_docstring_begins_with_what() -> None:
    """A docstring names its object, so that it stands by itself."""
    found = [
        f"{file}: {text}"
        for file, tree in trees().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and (text := ast.get_docstring(node) or "").startswith("What")
    ]
    assert not found
