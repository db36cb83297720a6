"""Untrusted input is read as data, never run as code."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

from simbias.trial.files import load_rollout

FILES = sorted(file for file in (ROOT / "simbias").rglob("*.py") if "__pycache__" not in file.parts)
RUNS_WHAT_IT_READS = {"pickle", "dill", "cloudpickle", "shelve", "marshal", "jsonpickle"}
OF_YAML = {"safe_load", "dump", "safe_dump", "SafeDumper"}  # which make plain values only,
OF_YAML |= {"compose", "SafeLoader", "Node", "CollectionNode", "YAMLError"}  # or none at all
READS_OF_OWN_WORKERS = ["loky.py"]  # by joblib, which unpickles too
COMPILES_OWN_TEXT = {
    "exec": ["compilation.py", "verification.py"],
    "compile": ["compilation.py", "verification.py"],
}


@pytest.mark.slow
def test_nothing_runs_what_it_reads() -> None:
    """Configs are read by OmegaConf, whose loader makes plain values only."""
    for file in FILES:
        for node in ast.walk(ast.parse(file.read_text())):
            check(file, node)


def check(file: Path, node: ast.AST) -> None:
    if isinstance(node, ast.Import):
        assert not RUNS_WHAT_IT_READS & {alias.name.partition(".")[0] for alias in node.names}
    elif isinstance(node, ast.ImportFrom):
        assert node.module not in RUNS_WHAT_IT_READS
        names = [alias.name for alias in node.names]
        assert node.module != "yaml" or names == ["YAMLError"]
        assert node.module != "joblib" or "load" not in names or file.name in READS_OF_OWN_WORKERS
    elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "yaml":
        assert node.attr in OF_YAML
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        allowed = COMPILES_OWN_TEXT.get(node.func.id, [])
        assert node.func.id not in ("eval", "exec", "compile") or file.name in allowed
    elif isinstance(node, ast.keyword):
        assert node.arg != "allow_pickle" or ast.unparse(node.value) == "False"


def test_a_file_of_a_trial_that_holds_objects_is_refused(tmp_path: Path) -> None:
    ran = tmp_path / "ran"

    class Evil:
        def __reduce__(self) -> tuple:
            return Path.touch, (ran,)

    names = ("states", "inputs", "parameters")
    np.savez(tmp_path / "evil.npz", **{name: np.array([Evil()], dtype=object) for name in names})
    with pytest.raises(ValueError, match="allow_pickle"):
        load_rollout(tmp_path / "evil.npz")
    assert not ran.exists()
