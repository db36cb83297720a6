"""The rules of CONTRIBUTING on who knows whom, held against the imports of every file."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from conftest import ROOT

PACKAGE = ROOT / "simbias"
COMPONENTS = (
    *("task", "nominal", "hardware", "policy", "identification", "samples"),
    *("bias", "cost", "evaluation", "optimizer", "method"),
)
ROBOTS = ("task", "nominal", "hardware")  # rooms that may know one
LARGEST_CIRCLE = 5  # files


def module(file: Path) -> str:
    """The dotted name of a file."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = sorted(file for file in PACKAGE.rglob("*.py") if "__pycache__" not in file.parts)
MODULES = {module(file): file for file in FILES}


def imports(file: Path) -> Iterator[str]:
    """The modules of simbias that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in MODULES else node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


@cache
def graph() -> dict[str, set[str]]:
    """The modules of simbias that each of them imports."""
    return {name: {found for found in imports(file) if found in MODULES} for name, file in MODULES.items()}


def circles() -> list[set[str]]:
    """Sets of more than one module that all import each other, over any number of others (Tarjan)."""
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    components: list[set[str]] = []

    def visit(name: str) -> None:
        order[name] = low[name] = len(order)
        stack.append(name)
        for other in graph()[name]:
            if other not in order:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], order[other])
        if low[name] == order[name]:
            component = set()
            while name not in component:
                component.add(stack.pop())
            components.append(component)

    for name in graph():
        if name not in order:
            visit(name)
    return [component for component in components if len(component) > 1]


def room(name: str) -> str:
    """The folder of a module."""
    return name.split(".")[1] if name.count(".") > 1 else ""


def test_no_circle_of_imports_is_large() -> None:
    assert max(map(len, circles()), default=0) <= LARGEST_CIRCLE, circles()


@pytest.mark.parametrize("name", [name for name in MODULES if room(name) in COMPONENTS])
def test_a_component_imports_none_of_another_group(name: str) -> None:
    """But for the robot's own: its model and its hardware know its task."""
    foreign = {found for found in graph()[name] if room(found) in COMPONENTS and room(found) != room(name)}
    if room(name) in ROBOTS:
        foreign = {found for found in foreign if room(found) != "task"}
    assert not foreign


@pytest.mark.parametrize("name", [name for name in MODULES if room(name) in COMPONENTS])
def test_a_component_knows_neither_stores_nor_sweeps_nor_terminals(name: str) -> None:
    rooms = {room(found) for found in graph()[name]}
    assert not rooms & {"tracking", "sweep", "terminal", "engine", "pictures"} or name.endswith("_drawing")


@pytest.mark.parametrize("name", [name for name in MODULES if room(name) not in ROBOTS])
def test_only_its_own_rooms_know_the_bongoboard(name: str) -> None:
    assert not re.search(r"bongoboard|pymunk|ankle|alpha_w", MODULES[name].read_text(), re.IGNORECASE)


@pytest.mark.parametrize(("library", "own_room"), [("mlflow", "tracking"), ("rich", "terminal")])
def test_only_its_own_room_imports(library: str, own_room: str) -> None:
    pattern = re.compile(rf"^\s*(?:from|import) {library}\b", re.MULTILINE)
    assert {room(name) for name, file in MODULES.items() if pattern.search(file.read_text())} == {own_room}
