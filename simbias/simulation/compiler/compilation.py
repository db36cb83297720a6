"""Compilation of Python functions with all that they call, cached on disk by a hash of everything.

A cache entry is identified by its inputs: the bytecode of every function involved, the constants they read
(also from the user's own modules), and the versions of Python, Numba and libraries. An entry therefore never
goes stale when any of these changes, wherever it is defined, and nothing is compiled twice. (Numba's own
cache notices changes in the file of a function, but not in the functions that it calls.) The folder of the
cache may be deleted at any time.
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

# A product and a sum may become one instruction. Finite numbers must not be assumed: a diverging rollout ends
# because its state is not finite.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
# For functions that only compiled code calls: entry points for Python take up to a third of compile time.
NOT_FROM_PYTHON: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
VERSIONS = (sys.version, numba.__version__, llvmlite.__version__, __name__)


def _use_whole_registers() -> None:
    """Let LLVM use the full width of vector registers, unless the user has configured Numba's processor.

    On many Intel processors it uses only half, since old ones slow down otherwise. On newer ones, this makes
    the closed loop up to a third slower. The numbers are the same.
    """
    settings: Any = numba.config  # whose attributes no type checker knows
    if settings.CPU_NAME is None and settings.CPU_FEATURES is None:
        features = llvmlite.binding.get_host_cpu_features()
        if features.get("avx512f"):
            settings.CPU_FEATURES = f"{features.flatten()},-prefer-256-bit"


_use_whole_registers()

_Function = TypeVar("_Function", bound=Callable)


def compiled_as(substitute: Callable) -> Callable[[_Function], _Function]:
    """Decorate a function for NumPy arrays so that compiled code calls `substitute` instead."""

    def mark(function: _Function) -> _Function:
        function.substitute = substitute  # type: ignore[attr-defined]
        return function

    return mark


_FUNCTIONS: dict[tuple[Any, ...], Callable] = {}


def function_of(text: str, name: str, **names: Any) -> Callable:
    """The function that a text defines, given these names; the same text and names give the same function.

    The text must not contain anything from a config: see `simbias.simulation.compiler.expressions`.
    """
    key = (text, name, *((each, id(value)) for each, value in names.items()))
    if key not in _FUNCTIONS:
        namespace = {**names, "__name__": __name__}
        exec(compile(text, f"<{name}>", "exec"), namespace)
        _FUNCTIONS[key] = namespace[name]
    return _FUNCTIONS[key]


_DISPATCHERS: dict[str, Any] = {}  # by the hash of their contents, so that each is compiled once


class Compilation:
    """Functions to be compiled together, and their hash."""

    def __init__(self) -> None:
        self._digest = hashlib.sha256()
        self._known: dict[int, tuple[str, Any, Callable]] = {}
        _note(self._digest, *VERSIONS, *OPTIONS, *OPTIONS.values())

    def compiled(self, function: Callable, inline: bool = True) -> Any:
        """A function that only compiled code can call; if `inline`, it is copied into its callers.

        Otherwise LLVM decides, depending on the processor. To keep the numbers the same, products are then
        not fused with sums, except by intrinsics.
        """
        digest, dispatcher, _ = self._hashed(function, inline)
        _note(self._digest, digest)
        return dispatcher

    @property
    def digest(self) -> str:
        """The hash of the functions so far."""
        return self._digest.hexdigest()[:24]

    def module(self, text: str, **names: Any) -> ModuleType:
        """A module with this text, given these names, in a file of the cache."""
        _note(self._digest, text, sorted(names))
        name = f"simbias_{self.digest}"
        if name not in sys.modules:
            file = _folder() / f"{name}.py"
            if not file.exists():
                _write(file, text)
            module = ModuleType(name)
            vars(module).update(names, __file__=str(file))
            exec(compile(text, file, "exec"), vars(module))
            sys.modules[name] = module  # Numba looks here for the globals of cached functions
        return sys.modules[name]

    def _hashed(self, function: Callable, inline: bool) -> tuple[str, Any, Callable]:
        """The hash of a function and all that it calls, the compiled function, and the function itself."""
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
        # Compiled code is loaded with the module of each function in it: with this one, wherever it lies.
        linked |= {"__builtins__": __builtins__, "__name__": __name__}
        copy = FunctionType(code, linked, function.__name__, function.__defaults__, closure)
        copy.__qualname__ = f"{function.__name__}_{digest.hexdigest()[:16]}"  # the name of its machine code
        return copy, digest.hexdigest()

    def _value(self, value: Any, names: set[str], inline: bool, digest: _Digest) -> Any:
        """The object that a global name stands for in compiled code, added to the digest."""
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
    """The names of globals and attributes that code reads."""
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
    """Write a file atomically with a fixed old time stamp: Numba checks files by their time."""
    with tempfile.NamedTemporaryFile("w", dir=file.parent, suffix=".py", delete=False) as new:
        new.write(text)
    os.utime(new.name, (1e9, 1e9))
    os.replace(new.name, file)
