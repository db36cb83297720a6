"""The package as text: its storeys, the libraries that it uses, what it may run, and its docstrings."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

from conftest import ROOT

PACKAGE = ROOT / "simbias"
STOREYS = (  # from the ground; folders of one line do not know each other
    ("core",),
    ("simulation/compiler",),
    ("simulation",),
    ("policy", "cost", "learning", "search"),
    ("learning/bias", "learning/identification", "learning/samples", "search/optimizer", "search/evaluation"),
    ("robots/mujoco",),
    ("robots",),
    ("robots/bongoboard", "robots/declared"),
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
# Numba documents some of its modules by these names.
DOCUMENTED = ("numba.core.cgutils", "numba.core.errors", "numba.core.event", "numba.core.types")
PRIVATE = re.compile(r"\._[a-z]|\.externals\b|^numba\.core\b")
RUNS_WHAT_IT_READS = {"pickle", "dill", "cloudpickle", "shelve", "marshal", "jsonpickle"}
OF_YAML = {"safe_load", "dump", "safe_dump", "SafeDumper"}  # which make plain values only,
OF_YAML |= {"compose", "SafeLoader", "Node", "CollectionNode", "YAMLError"}  # or none at all
COPIES_IN_MEMORY = "hydra_config.py"  # by pickle
READS_OF_OWN_WORKERS = ["loky.py"]  # by joblib, which unpickles too
COMPILE_OWN_TEXT = ["compilation.py", "verification.py"]

FILES = {
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
    for file in sorted(PACKAGE.rglob("*.py"))
    if "__pycache__" not in file.parts
}
MODULES = {name: file for name, file in FILES.items() if "templates" not in file.parts}


@cache
def nodes(name: str) -> list[ast.AST]:
    """All that a module consists of."""
    return list(ast.walk(ast.parse(FILES[name].read_text())))


def folder(name: str) -> str:
    """The folder of a module, within the package; a program's entry belongs to the top."""
    file = MODULES[name]
    return "" if file.stem == "__main__" else file.parent.relative_to(PACKAGE).as_posix().removeprefix(".")


@cache
def imports(name: str) -> set[str]:
    """Modules and names in full that a module imports: anywhere in it, also for type checkers alone."""
    names: set[str] = set()
    for node in nodes(name):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def own(name: str) -> set[str]:
    """The modules of simbias that a module imports."""
    return {each if each in MODULES else each.rpartition(".")[0] for each in imports(name)} & MODULES.keys()


def of_others(name: str) -> set[str]:
    """What it imports from other packages."""
    known = (*sys.stdlib_module_names, "simbias")
    return {each for each in imports(name) if each.split(".")[0] not in known}


def test_every_folder_has_a_storey() -> None:
    assert {folder(name) for name in MODULES} == HEIGHT.keys()


def test_few_files_lie_on_top_of_the_package() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= 5


def test_a_folder_imports_lower_storeys_only() -> None:
    upwards = [
        f"{name} -> {found}"
        for name in MODULES
        for found in own(name)
        if folder(found) != folder(name) and HEIGHT[folder(found)] >= HEIGHT[folder(name)]
    ]
    assert not upwards


def test_the_compiler_has_one_door() -> None:
    """Who uses it imports from `simbias.simulation.compiler`, from no module within."""
    inner = "simbias.simulation.compiler."
    assert not {
        f"{name} -> {found}"
        for name in MODULES
        for found in own(name)
        if found.startswith(inner) and not name.startswith(inner.removesuffix("."))
    }


def test_only_its_own_folder_knows_the_bongoboard() -> None:
    knows = re.compile(r"bongoboard|pymunk|ankle|alpha_w", re.IGNORECASE)
    outside = [
        name for name in MODULES if not folder(name).startswith("robots") and name != "simbias.config.renamed"
    ]  # which says where things are now
    assert not [name for name in outside if knows.search(MODULES[name].read_text())]


def test_only_its_own_folder_imports_a_library() -> None:
    for library, only in (("mlflow", "mlflow"), ("rich", "terminal"), ("hydra", "config")):
        users = [name for name in MODULES if library in {each.split(".")[0] for each in of_others(name)}]
        assert {folder(name) for name in users} == {only}


def own_names(name: str) -> Iterator[str]:
    """The names that a module defines, also on instances."""
    for node in nodes(name):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr


def attributes(name: str) -> Iterator[str]:
    """The attributes of others that a module reads, or asks for by name."""
    for node in nodes(name):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) not in ("self", "cls"):
            yield node.attr
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("getattr", "hasattr"):
            yield ast.literal_eval(node.args[1]) if isinstance(node.args[1], ast.Constant) else ""


def test_no_private_parts() -> None:
    """Nor does a module use those of another one."""
    found = {}
    for name in MODULES:
        documented = {"_asdict", "_exit", "_fields", "_make", "_replace"}
        allowed = documented.union(own_names(name))
        private = {each for each in of_others(name) if PRIVATE.search(each)}
        private = {each for each in private if not each.startswith(DOCUMENTED)}
        private |= {each for each in attributes(name) if re.match("_[a-z]", each) and each not in allowed}
        if private:
            found[name] = private
    assert not found


def test_what_is_imported_is_declared() -> None:
    """And what every user installs is imported."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    always = set(map(name_of, project["dependencies"]))
    extras = {name_of(line) for lines in project["optional-dependencies"].values() for line in lines}
    packages = packages_distributions()
    modules = {each.split(".")[0] for name in MODULES for each in of_others(name)}
    needed = {module: {name_of(each) for each in packages.get(module, [module])} for module in modules}
    assert {module for module, names in needed.items() if not names & (always | extras)} == set()
    assert always - set().union(*needed.values()) == set()


def name_of(requirement: str) -> str:
    """The name of a package, as registries compare it."""
    return re.split(r"[\[<>=;, ]", requirement)[0].lower().replace("_", "-")


def test_no_docstring_begins_with_what() -> None:
    """A docstring names its object, so that it stands by itself."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    found = [
        f"{name}: {text}"
        for name in MODULES
        for node in nodes(name)
        if isinstance(node, documented) and (text := ast.get_docstring(node) or "").startswith("What")
    ]
    assert not found


def test_nothing_runs_what_it_reads() -> None:
    """Configs are read by OmegaConf, whose loader makes plain values only."""
    for name, file in FILES.items():
        for node in nodes(name):
            check(file, node)


def check(file: Path, node: ast.AST) -> None:
    if isinstance(node, ast.Import):
        names = {alias.name.partition(".")[0] for alias in node.names}
        assert not RUNS_WHAT_IT_READS & names or (file.name == COPIES_IN_MEMORY and names == {"pickle"})
    elif isinstance(node, ast.ImportFrom):
        assert node.module not in RUNS_WHAT_IT_READS
        imported = [alias.name for alias in node.names]
        assert node.module != "yaml" or imported == ["YAMLError"]
        assert node.module != "joblib" or "load" not in imported or file.name in READS_OF_OWN_WORKERS
    elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "yaml":
        assert node.attr in OF_YAML
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        assert node.func.id != "eval"
        assert node.func.id not in ("exec", "compile") or file.name in COMPILE_OWN_TEXT
    elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "pickle":
        assert node.attr in ("dumps", "loads")  # no file
    elif isinstance(node, ast.keyword):
        assert node.arg != "allow_pickle" or ast.unparse(node.value) == "False"
