"""The storeys of the package, held against the imports of every file: a folder imports lower ones only."""

from __future__ import annotations

import ast
import re
from functools import cache

from conftest import ROOT

PACKAGE = ROOT / "simbias"
STOREYS = (  # from the ground; folders of one line do not know each other
    ("core",),
    ("simulation/compiler",),
    ("simulation",),
    ("policy", "cost", "learning", "search"),
    ("learning/bias", "learning/identification", "learning/samples", "search/optimizer", "search/evaluation"),
    ("robots/mujoco", "robots/drawing"),
    ("robots/bongoboard", "robots/declared", "robots"),
    ("lab",),
    ("lab/requests",),
    ("trial",),
    ("trial/methods", "config", "engine"),
    ("testing", "pictures/elements"),
    ("pictures/trial",),
    ("pictures",),
    ("recordings",),
    ("sweep",),
    ("sweep/figures", "report"),
    ("mlflow",),
    ("terminal",),
    ("",),  # the few files on top of the package
)
HEIGHT = {folder: height for height, folders in enumerate(STOREYS) for folder in folders}

MODULES = {
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
    for file in sorted(PACKAGE.rglob("*.py"))
    if not {"__pycache__", "templates"} & set(file.parts)
}


def folder(name: str) -> str:
    """The folder of a module, within the package; a program's entry belongs to the top."""
    file = MODULES[name]
    return "" if file.stem == "__main__" else file.parent.relative_to(PACKAGE).as_posix().removeprefix(".")


@cache
def imports(name: str) -> set[str]:
    """The modules of simbias that a module imports: anywhere in it, also for type checkers alone."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(MODULES[name].read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {each if each in MODULES else node.module for each in inner}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & MODULES.keys()


def test_every_folder_has_a_storey() -> None:
    assert {folder(name) for name in MODULES} == HEIGHT.keys()


def test_few_files_lie_on_top_of_the_package() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= 5


def test_a_folder_imports_lower_storeys_only() -> None:
    upwards = [
        f"{name} -> {found}"
        for name in MODULES
        for found in imports(name)
        if folder(found) != folder(name) and HEIGHT[folder(found)] >= HEIGHT[folder(name)]
    ]
    assert not upwards


def test_the_compiler_has_one_door() -> None:
    """Who uses it imports from `simbias.simulation.compiler`, from no module within."""
    inner = "simbias.simulation.compiler."
    assert not {
        f"{name} -> {found}"
        for name in MODULES
        for found in imports(name)
        if found.startswith(inner) and not name.startswith(inner.removesuffix("."))
    }


def test_only_its_own_folder_knows_the_bongoboard() -> None:
    knows = re.compile(r"bongoboard|pymunk|ankle|alpha_w", re.IGNORECASE)
    outside = [
        name for name in MODULES if not folder(name).startswith("robots") and name != "simbias.config.renamed"
    ]  # which says where things are now
    assert not [name for name in outside if knows.search(MODULES[name].read_text())]


def test_only_its_own_folder_imports_a_library() -> None:
    for library, own in (("mlflow", "mlflow"), ("rich", "terminal"), ("hydra", "config")):
        pattern = re.compile(rf"^\s*(?:from|import) {library}\b", re.MULTILINE)
        assert {folder(name) for name, file in MODULES.items() if pattern.search(file.read_text())} == {own}
