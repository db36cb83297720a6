"""MuJoCo's step for compiled loops, which call the engine's functions directly, without Python.

A kernel takes only numbers. Its parameters are therefore addresses: of a model, and of a table of work areas
for the engine, one for each thread, each with a flag that marks it as taken.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any
from weakref import WeakSet, finalize

import llvmlite.binding
import numba
import numpy as np
from llvmlite import ir
from numba import extending, types

from simbias.core import Kernel
from simbias.core.records import Array
from simbias.robots.mujoco.mjcf import Mechanism
from simbias.robots.mujoco.parameters import mujoco
from simbias.simulation.compiler import compiled_as, function_of

ABSURD = 1e4  # m, rad, m/s, rad/s: beyond, it has diverged, and the engine would write log files
FREE, TAKEN = 0, 1
WORDS, WORD = 8, 8  # words of a table entry, and bytes of a word: one cache line, so that no thread waits
_ADDRESS, _FLAGS = types.intp, types.int32
_SIGNATURES: dict[str, Any] = {
    "mj_setState": types.void(_ADDRESS, _ADDRESS, _ADDRESS, _FLAGS),
    "mj_getState": types.void(_ADDRESS, _ADDRESS, _ADDRESS, _FLAGS),
    "mj_step": types.void(_ADDRESS, _ADDRESS),
}
_FUNCTIONS: list[Any] = [types.ExternalFunction(*each) for each in _SIGNATURES.items()]
_SET_STATE, _GET_STATE, _STEP = _FUNCTIONS
_SETTINGS: Any = numba.config  # whose attributes no type checker knows
intrinsic: Any = extending.intrinsic  # its annotations include the context as an argument


class EngineModel:
    """A copy of a model, passed to the engine's functions by its address."""

    def __init__(self, model: Any) -> None:
        buffer = np.empty(mujoco().mj_sizeModel(model), np.uint8)
        mujoco().mj_saveModel(model, None, buffer)
        self.address: int = _library().mj_loadModelBuffer(buffer.ctypes.data, len(buffer))
        finalize(self, _library().mj_deleteModel, self.address).atexit = False


class Places:
    """Work areas (engine data) for models of one file, one per thread; steps do not depend on leftovers."""

    def __init__(self, model: EngineModel) -> None:
        self.table = np.full((_SETTINGS.NUMBA_NUM_THREADS, WORDS), FREE, np.int64)
        for place in self.table:
            place[1] = data = _library().mj_makeData(model.address)
            finalize(self, _library().mj_deleteData, data).atexit = False
        _ALL.add(self)


_ALL: WeakSet[Places] = WeakSet()


def _free_all() -> None:
    """Free all places after a fork, which threads that had taken places do not survive."""
    for places in _ALL:
        places.table[:, 0] = FREE


os.register_at_fork(after_in_child=_free_all)


def kernel(robot: Mechanism, model: EngineModel, places: Places) -> Kernel:
    """The kernel of a frame of the robot; a diverged state is nan.

    The caller must keep model and places alive: the parameters are their addresses, exact in 53 bits.
    """
    for name in _SIGNATURES:
        llvmlite.binding.add_symbol(name, ctypes.cast(_library()[name], ctypes.c_void_p).value)
    addresses = model.address, places.table.ctypes.data, len(places.table)
    return Kernel(_frame(robot), np.array(addresses, dtype=np.float64))


@cache
def _library() -> ctypes.CDLL:
    """The engine's functions, from the library that its Python bindings link to."""
    version = mujoco().__version__
    names = {"darwin": f"libmujoco.{version}.dylib", "win32": "mujoco.dll"}
    file = Path(mujoco().__file__).parent / names.get(sys.platform, f"libmujoco.so.{version}")
    library = ctypes.CDLL(str(file))
    library.mj_loadModelBuffer.argtypes = ctypes.c_void_p, ctypes.c_int
    for create in (library.mj_loadModelBuffer, library.mj_makeData):
        create.restype = ctypes.c_void_p
    for take in (library.mj_makeData, library.mj_deleteModel, library.mj_deleteData):
        take.argtypes = (ctypes.c_void_p,)
    return library


def _frame(robot: Mechanism) -> Callable:
    """The kernel of robots with the same layout of states and inputs."""
    kinds = mujoco().mjtState
    after = int(kinds.mjSTATE_FULLPHYSICS)
    before = after | int(kinds.mjSTATE_WARMSTART | kinds.mjSTATE_CTRL)
    begin = mujoco().mj_stateSize(robot.model, before) - robot.model.nu  # of the controls, which come last
    states, controls = robot.state_places.tolist(), [begin + place for place in robot.control_places.tolist()]
    units = robot.units.tolist()
    possible = [f"abs(x[{i}]) < {ABSURD}" for i in range(len(states))]
    possible += [f"abs(u[{i}]) < np.inf" for i in range(len(controls))]
    lines = [
        "def frame(x, u, parameters):",
        f"    state = np.zeros({begin + robot.model.nu})",
        *(f"    state[{place}] = x[{i}]" for i, place in enumerate(states)),
        *(f"    state[{place}] = u[{i}] / {units[i]!r}" for i, place in enumerate(controls)),
        f"    if {' and '.join(possible)}:",  # safe for the engine
        f"        advance(state, parameters, {before}, {after}, {robot.substeps})",
        "    else:",
        "        state[:] = np.nan",
        f"    return ({''.join(f'state[{place}], ' for place in states)})",
    ]
    return function_of("\n".join(lines) + "\n", "frame", np=np, advance=_advance)


def _advance_in_place(state, parameters, before, after, steps):
    """Advance the state by this number of steps, in the first free place."""
    model, table, count = int(parameters[0]), int(parameters[1]), int(parameters[2])
    i = 0
    while not _exchanged(table + i * WORDS * WORD, FREE, TAKEN):
        i = (i + 1) % count
    place = table + i * WORDS * WORD
    data = _word(place + WORD)
    _SET_STATE(model, data, state.ctypes.data, before)
    for _ in range(steps):
        _STEP(model, data)
    _GET_STATE(model, data, state.ctypes.data, after)
    _exchanged(place, TAKEN, FREE)


@compiled_as(_advance_in_place)
def _advance(state: Array, parameters: Array, before: int, after: int, steps: int) -> None:
    """Advance the state by this number of steps in Python, in its own place, for comparison."""
    engine, model = _library(), ctypes.c_void_p(int(parameters[0]))
    data, numbers = ctypes.c_void_p(engine.mj_makeData(model)), state.ctypes.data_as(ctypes.c_void_p)
    engine.mj_setState(model, data, numbers, before)
    for _ in range(steps):
        engine.mj_step(model, data)
    engine.mj_getState(model, data, numbers, after)
    engine.mj_deleteData(data)


_INTEGER = ir.IntType(64)


@intrinsic
def _word(context, address):
    """The integer at an address."""

    def generate(context, builder, signature, arguments):
        return builder.load(builder.inttoptr(arguments[0], _INTEGER.as_pointer()))

    return types.int64(types.int64), generate


@intrinsic
def _exchanged(context, address, expected, value):
    """Atomic compare-and-exchange: whether the integer at an address was as expected, and is now `value`."""

    def generate(context, builder, signature, arguments):
        pointer = builder.inttoptr(arguments[0], _INTEGER.as_pointer())
        result = builder.cmpxchg(pointer, arguments[1], arguments[2], "acq_rel", "acquire")
        return builder.extract_value(result, 1)

    return types.boolean(types.int64, types.int64, types.int64), generate
