"""Engines use of other packages what these promise to keep, and what pyproject declares."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from conftest import ROOT

FILES = sorted((ROOT / "simbias" / "engine").glob("*.py"))


def imports(file: Path) -> set[str]:
    """Modules and names in full, of other packages."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in names if name.split(".")[0] not in (*sys.stdlib_module_names, "simbias")}


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_no_private_parts(file: Path) -> None:
    assert [name for name in imports(file) if re.search(r"\._|\.externals", name)] == []


@pytest.mark.slow
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_what_is_imported_is_declared(file: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [*project["dependencies"], *project["optional-dependencies"]["dask"]]
    declared = {name for line in lines for name in re.findall(r"[a-z][a-z0-9_-]*", line)}
    packages = packages_distributions()
    needed = {name.split(".")[0] for name in imports(file)}
    assert {
        name for name in needed if not {n.lower() for n in packages.get(name, [name])} & declared
    } == set()
