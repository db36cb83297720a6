"""Ordinary Python functions, compiled with all that they call and kept on disk under the hash of all of it.

A cache entry is found by what it was made of: the bytecode of every function involved, the constants that
these read, also from the user's own modules, and the versions of Python, Numba and libraries. So nothing goes
stale when any of it changes, wherever it is written, and nothing is compiled twice. (Numba's own cache
notices changes in the file of a function, but not in the functions that it calls.) The folder of the cache
may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CellType, CodeType, FunctionType, ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import llvmlite
import numba
import numpy as np
from numba import njit
from numba.extending import is_jitted

from simbias.core.cache import cache_folder
from simbias.core.error_origin import is_users

if TYPE_CHECKING:
    from hashlib import _Hash as _Digest

# A product and a sum may become one instruction. Nothing may assume that numbers are finite: a rollout that
# blows up ends because its state is not finite.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
# Of functions that only compiled code calls: entry points for Python take up to a third of compiling.
NOT_FROM_PYTHON: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
VERSIONS = (sys.version, numba.__version__, llvmlite.__version__, __name__)


def _use_whole_registers() -> None:
    """Let LLVM use vector registers in full, unless the user has told Numba what the processor can.

    Of many Intel processors it uses half of each, since old ones slow down otherwise. On newer ones, the
    closed loop then takes up to a third more time. Numbers stay the same.
    """
    settings: Any = numba.config  # whose attributes no type checker knows
    if settings.CPU_NAME is None and settings.CPU_FEATURES is None:
        features = llvmlite.binding.get_host_cpu_features()
        if features.get("avx512f"):
            settings.CPU_FEATURES = f"{features.flatten()},-prefer-256-bit"


_use_whole_registers()

_Function = TypeVar("_Function", bound=Callable)


def compiled_as(substitute: Callable) -> Callable[[_Function], _Function]:
    """Let compiled code call `substitute` where a function is called that is written for NumPy's arrays."""

    def mark(function: _Function) -> _Function:
        function.substitute = substitute  # type: ignore[attr-defined]
        return function

    return mark


_FUNCTIONS: dict[tuple[str, str], Callable] = {}


def function_of(text: str, name: str, **names: Any) -> Callable:
    """The function that a text defines, in which these names have a meaning; of the same text, the same one.

    Nothing in it may be a config's: see `simbias.simulation.compiler.expressions`.
    """
    key = (text, name)
    if key not in _FUNCTIONS:
        namespace = {**names, "__name__": __name__}
        exec(compile(text, f"<{name}>", "exec"), namespace)
        _FUNCTIONS[key] = namespace[name]
    return _FUNCTIONS[key]


_DISPATCHERS: dict[str, Any] = {}  # by the hash of all that they do, so that each is compiled once


class Compilation:
    """Functions to be compiled together; their hash."""

    def __init__(self) -> None:
        self._digest = hashlib.sha256()
        self._known: dict[int, tuple[str, Any, Callable]] = {}
        _note(self._digest, *VERSIONS, *OPTIONS, *OPTIONS.values())

    def compiled(self, function: Callable, inline: bool = True) -> Any:
        """A function that only compiled code can call, into which it is copied if it is `inline`.

        If it is not, LLVM decides by the kind of processor; so that this changes no number, its products then
        stay products, where no intrinsic says otherwise.
        """
        digest, dispatcher, _ = self._hashed(function, inline)
        _note(self._digest, digest)
        return dispatcher

    @property
    def digest(self) -> str:
        """The hash of what there is so far."""
        return self._digest.hexdigest()[:24]

    def module(self, text: str, **names: Any) -> ModuleType:
        """A module of this text, in which these names have a meaning; in a file of the cache."""
        _note(self._digest, text, sorted(names))
        name = f"simbias_{self.digest}"
        if name not in sys.modules:
            file = _folder() / f"{name}.py"
            if not file.exists():
                _write(file, text)
            module = ModuleType(name)
            vars(module).update(names, __file__=str(file))
            exec(compile(text, file, "exec"), vars(module))
            sys.modules[name] = module  # where Numba looks for the globals of what it finds in its cache
        return sys.modules[name]

    def _hashed(self, function: Callable, inline: bool) -> tuple[str, Any, Callable]:
        """The hash of a function and of all that it calls, it compiled, and the function itself."""
        function = getattr(function, "substitute", function)
        function = function.py_func if is_jitted(function) else function
        key = id(function)
        if key not in self._known:
            self._known[key] = "itself", None, function
            linked, digest = self._linked(function, inline)
            if digest not in _DISPATCHERS:
                options = OPTIONS if inline else OPTIONS | {"fastmath": {"nsz"}}
                _DISPATCHERS[digest] = njit(**options, **NOT_FROM_PYTHON, forceinline=inline)(linked)
            self._known[key] = digest, _DISPATCHERS[digest], function
        return self._known[key]

    def _linked(self, function: Any, inline: bool) -> tuple[Callable, str]:
        """A copy of a Python function that calls compiled functions, and its hash."""
        code, digest = function.__code__, hashlib.sha256()
        names, known = set(_names(code)), function.__globals__
        used = sorted(names & known.keys())
        linked = {name: self._value(known[name], names, inline, digest) for name in used}
        cells = function.__closure__ or ()
        closure = tuple(CellType(self._value(cell.cell_contents, names, inline, digest)) for cell in cells)
        _note(digest, inline, function.__name__, *_description(code))
        self._value(function.__defaults__, names, inline, digest)
        # Compiled code is loaded with the module of each function in it: with this one, wherever that is.
        linked |= {"__builtins__": __builtins__, "__name__": __name__}
        copy = FunctionType(code, linked, function.__name__, function.__defaults__, closure)
        copy.__qualname__ = f"{function.__name__}_{digest.hexdigest()[:16]}"  # names its machine code
        return copy, digest.hexdigest()

    def _value(self, value: Any, names: set[str], inline: bool, digest: _Digest) -> Any:
        """The object that a name stands for in code that reads these names, noted in the digest."""
        if isinstance(value, FunctionType) or is_jitted(value):
            hashed, value, _ = self._hashed(value, inline)
            _note(digest, hashed)
        elif isinstance(value, np.ndarray):
            _note(digest, value.dtype, value.shape, value.tobytes())
        elif isinstance(wrapped := inspect.unwrap(value), FunctionType):  # an intrinsic: its file
            _note(digest, value.__module__, Path(wrapped.__code__.co_filename).read_bytes())
        elif isinstance(value, ModuleType):
            _note(digest, value.__name__, getattr(value, "__version__", None))
            where = getattr(value, "__file__", None) or next(iter(getattr(value, "__path__", ())), "")
            if is_users(where):
                for name in sorted(names & vars(value).keys()):
                    self._value(vars(value)[name], names - {name}, inline, digest)
        elif isinstance(value, tuple):
            _note(digest, type(value).__name__, getattr(value, "_fields", len(value)))
            for each in value:
                self._value(each, names, inline, digest)
        else:
            _note(digest, value)
        return value


def _note(digest: _Digest, *values: Any) -> None:
    """Add values to a hash."""
    for value in values:
        ordered = sorted(map(repr, value)) if isinstance(value, set | frozenset) else value
        digest.update(repr(ordered).encode())


def _names(code: CodeType) -> Iterator[str]:
    """The global names that code reads, and its attributes' names."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _description(code: CodeType) -> Iterator[Any]:
    """Bytecode, names and constants of code, independent of its place in a file."""
    yield from (code.co_code, code.co_names, code.co_varnames, code.co_freevars)
    for constant in code.co_consts:
        yield tuple(_description(constant)) if isinstance(constant, CodeType) else constant


def _folder() -> Path:
    """The folder of compiled code: Numba's own if it is set, else among the caches."""
    settings: Any = numba.config  # whose attributes no type checker knows
    return cache_folder("closed_loops", *filter(None, [settings.CACHE_DIR]))


def _write(file: Path, text: str) -> None:
    """Write a file at once, and as if it had always been there: Numba trusts a file by its time."""
    with tempfile.NamedTemporaryFile("w", dir=file.parent, suffix=".py", delete=False) as new:
        new.write(text)
    os.utime(new.name, (1e9, 1e9))
    os.replace(new.name, file)
