"""What is compiled is kept, and is never what it was before a change."""

import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout
from io import StringIO
from multiprocessing import get_context
from pathlib import Path
from textwrap import dedent
from types import ModuleType
from unittest.mock import Mock

import llvmlite.binding
import numba
import numpy as np
import pytest
from numba import njit

from simbias.core import cache
from simbias.simulation.compiler import compilation
from simbias.simulation.compiler.compilation import OPTIONS, Compilation

pytestmark = pytest.mark.slow

OWN = """
from helper import half

LIMIT = 7.0

def own(x):
    return min(half(x), LIMIT)
"""
HELPER = """
def half(x):
    return 0.5 * x
"""
RUN = """
from numba import njit
from own import own
from simbias.core import cache
from simbias.simulation.compiler import compilation
from simbias.simulation.compiler.compilation import OPTIONS, Compilation

compilation = Compilation()
function = compilation.compiled(own)
module = compilation.module("def entry(x):\\n    return function(x)\\n", function=function)
entry = njit(**OPTIONS, cache=True)(module.entry)
print(entry(4.0), entry(40.0), sum(entry.stats.cache_misses.values()))
"""


def run(folder: Path) -> str:
    """What a process that knows none of it computes, and how often it had to compile."""
    with ProcessPoolExecutor(1, get_context("fork")) as process:  # which has imported Numba
        return process.submit(_run, str(folder)).result()


def _run(folder: str) -> str:
    """The script's output; its modules are there."""
    sys.path.insert(0, folder)
    numba.config.CACHE_DIR = folder
    with redirect_stdout(StringIO()) as out:
        exec(RUN, {})
    return out.getvalue().strip()


def run_with_other_hashes(folder: Path) -> str:
    """The same, in a process of its own."""
    environment = os.environ | {"PYTHONHASHSEED": "random", "NUMBA_CACHE_DIR": str(folder)}
    environment |= {"PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
    script = [sys.executable, "-c", RUN]
    return subprocess.run(script, env=environment, capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of a fork beside threads, which rest
def test_a_change_anywhere_is_compiled_and_nothing_is_compiled_twice(tmp_path: Path) -> None:
    """In the function, in one that it calls from another file, and in a constant."""

    def write(own: str = OWN, helper: str = HELPER) -> None:
        for name, text in (("own", own), ("helper", helper)):
            (tmp_path / f"{name}.py").write_text(text)
            os.utime(tmp_path / f"{name}.py", (1e9, 1e9))  # as a restored backup: its time says nothing
        for cached in (tmp_path / "__pycache__").glob("*"):
            cached.unlink()  # Python's own, which trusts times

    write()
    assert run(tmp_path) == "2.0 7.0 1"
    assert run_with_other_hashes(tmp_path) == "2.0 7.0 0"
    write(helper=HELPER.replace("0.5", "0.25"))
    assert run(tmp_path) == "1.0 7.0 1"
    write(own=OWN.replace("7.0", "8.0").replace("min", "max"))
    assert run(tmp_path) == "8.0 20.0 1"
    write()
    (tmp_path / "helper.py").rename(tmp_path / "moved.py")
    write_own = OWN.replace("from helper", "from moved")
    (tmp_path / "own.py").write_text(write_own)
    assert run(tmp_path) == "2.0 7.0 0"  # what it was is still there, wherever it is now


def test_the_hash_is_of_what_a_function_does() -> None:
    def digest(text: str, **names: object) -> str:
        scope: dict = dict(names)
        exec(dedent(text), scope)
        compilation = Compilation()
        compilation.compiled(scope["f"])
        return compilation.digest

    text = "def f(x):\n    return x * a"
    assert digest(text, a=1.0) == digest("\n\n" + text, a=1.0, b=2.0)
    assert digest(text, a=1.0) != digest(text, a=2.0)
    assert digest(text, a=np.ones(2)) != digest(text, a=np.zeros(2))
    one, other = ((np.array([value]),) for value in (0.1234567891, 0.1234567892))
    assert digest(text, a=one) != digest(text, a=other)
    first, second = ModuleType("own"), ModuleType("own")
    vars(first).update(a=1.0, b=1.0, own=second, __file__=__file__)
    vars(second).update(a=1.0, b=2.0, own=first, __file__=__file__)
    reading = "def f(x):\n    return x * own.{}"
    assert digest(reading.format("a"), own=first) == digest(reading.format("a"), own=second)
    assert digest(reading.format("b"), own=first) != digest(reading.format("b"), own=second)
    assert digest(text, a=1.0) != digest("def f(x):\n    return x + a", a=1.0)
    closure = "def g(n):\n    def f(x):\n        return x**n\n    return f\nf = g({})"
    assert digest(closure.format(2)) != digest(closure.format(3))


@pytest.mark.skipif(sys.platform == "win32", reason="temporary folders are a user's own")
def test_nothing_is_read_from_a_folder_of_another_user(tmp_path: Path, monkeypatch) -> None:
    """Numba runs what it finds in its cache."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    assert compilation._folder() == tmp_path / "closed_loops"
    monkeypatch.setattr(cache, "__file__", "/proc/nowhere/cache.py")  # as an administrator installs it
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert compilation._folder() == tmp_path / "simbias" / "closed_loops"
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nowhere")
    monkeypatch.setattr(cache.tempfile, "tempdir", str(tmp_path))
    private = tmp_path / f"simbias-{os.getuid()}"
    assert compilation._folder() == private / "closed_loops"
    assert private.stat().st_mode & 0o077 == 0
    monkeypatch.delenv("XDG_CACHE_HOME")
    with monkeypatch.context() as patch:  # a user without a home, as in some containers
        patch.setattr(cache.Path, "home", Mock(side_effect=RuntimeError))
        assert compilation._folder() == private / "closed_loops"
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nowhere")
    private.chmod(0o777)
    with pytest.raises(OSError, match="is another user's; set XDG_CACHE_HOME to a folder"):
        compilation._folder()
    private.rename(tmp_path / "other")
    private.symlink_to("other")
    with pytest.raises(OSError, match="is another user's"):
        compilation._folder()


def test_vector_registers_are_used_in_full() -> None:
    """Sixteen lanes take as few instructions as the processor allows."""
    if not llvmlite.binding.get_host_cpu_features().get("avx512f") or os.environ.get("NUMBA_CPU_NAME"):
        pytest.skip("its registers have no half that LLVM would prefer")

    @njit(**OPTIONS)
    def add(x: np.ndarray, y: np.ndarray) -> None:
        for i in range(len(x)):
            y[i] += 2.5 * x[i]

    add(np.zeros(100), np.zeros(100))
    (assembly,) = add.inspect_asm().values()
    assert "zmm" in assembly
