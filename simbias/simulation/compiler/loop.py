"""A compiled loop over many passes in lockstep, one in each lane of vector registers.

A pass is a rollout, or the prediction of a recorded experiment. It takes a free lane and is stepped frame by
frame; when it ends, another takes its place. A lane without a pass computes unused numbers. There is thus one
path through the code, and the numbers of a pass do not depend on other passes.

The source is generated for each composition of kernels: loops over the components of a vector are written
out, and one loop over the lanes contains everything, so that LLVM keeps results in registers. All lanes are
in one array (`x[i, lane]`), including integers: for two arrays, LLVM would have to check whether they
overlap. Beyond about a hundred rows it skips this check, and compiles one pass after the other.
"""

from __future__ import annotations

import inspect
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache, partial
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np
from numba import get_num_threads, njit

from simbias.core import Kernel
from simbias.core.records import Array
from simbias.simulation.compiler.compilation import OPTIONS, Compilation
from simbias.simulation.compiler.kernels import LANES
from simbias.simulation.compiler.lanes import as_integers

SHORT = 8 * LANES  # passes that take one thread at most 2 s: 5000 frames with an exact Gaussian process
INTEGERS = ("running", "number", "frame", "ending")  # of each lane; a lane without a pass is not running

TEMPLATE = f"""\
def loop(
    {{arguments}}
    begin, end, interrupted,
):
    {{rows}}
    {{constants}}
    x[:] = nan  # in a lane without a pass, so that no kernel works for nothing
    ended, under_way = 1, 0
    while interrupted[0] == 0:
        if ended > 0:  # others take their places
            ended = 0
            for lane in range({LANES}):
                if running[lane] == 0 and begin < end:
                    b = begin
                    begin += 1
                    under_way += 1
                    running[lane], number[lane], frame[lane] = 1, b, 0
                    {{take}}
            if under_way == 0:
                return
        {{gather}}
        for lane in range({LANES}):
            {{advance}}
            {{judge}}
        {{settle}}
        {{record}}
        if ended > 0:
            for lane in range({LANES}):
                if running[lane] == 1 and ending[lane] == 1:
                    b = number[lane]
                    running[lane] = 0
                    under_way -= 1
                    {{release}}
                    for i in range(x.shape[0]):
                        x[i, lane] = nan
"""


class Function(NamedTuple):
    """A kernel's function, and the number of parameters that it reads one by one."""

    function: Callable
    parameters: int

    @staticmethod
    def of(kernel: Kernel) -> Function:
        """The function of a kernel; its parameters are (r,), (k, r), or arrays passed unchanged."""
        parameters = kernel.parameters
        return Function(kernel.function, 0 if isinstance(parameters, tuple) else parameters.shape[-1])

    @property
    def takes_all_lanes(self) -> bool:
        """Whether the function is the kernel of a bias that works on all lanes."""
        return len(inspect.signature(self.function).parameters) == len(("x", "u", "data", "correction"))

    def read(self, name: str, array: str = "") -> str:
        """A line that reads the parameters shared by all lanes."""
        array = array or f"{name}_parameters"
        return f"{name}_data = {tuple_of(f'{array}[{{}}]', self.parameters)}"

    def own(self, rows: str) -> str:
        """The text of per-lane parameters, in these rows."""
        return tuple_of(f"{rows}[{{}}, lane]", self.parameters)


@dataclass(frozen=True)
class Loop:
    """The source of a loop: x_new (n,) = step(x_, u_) + correct(x_, u_) (Eq. 7), and the surrounding steps.

    The acting input may differ from u_, if the model keeps it: `acting`.

    Blocks are lines of text; `b` is a pass, `x_`, `u_`, `x_new` are tuples, rows are `x[i, lane]`.
    """

    arguments: str  # arguments before those in the template
    functions: Mapping[str, Function]  # by their names in the text; `step` and `correct` among them
    n: int  # states
    m: int  # inputs
    n_model_state: int  # size of the nominal model's state
    rows: Mapping[str, int]  # of the lanes, in addition to those that a step needs
    integers: Sequence[str]  # rows of integers, in addition to INTEGERS
    constants: Sequence[str]  # read once
    take: str  # when a pass b begins: sets x and `model`, the number of its nominal model
    gather: str  # before a frame: reads data for the lanes
    advance: Sequence[str]  # in a frame, for each lane: sets x_ and u_
    settle: Sequence[str]  # in a frame, for each lane: uses x_new
    judge: str  # after these, for each lane; `ended` counts those that are `ending`
    record: str  # after a frame
    release: str  # when a pass b has ended
    targets: int = 0  # number of targets, the last of the states, which stay constant
    acting: tuple[int, ...] = ()  # entries of the next model state: inputs of `correct` instead of u_

    def compiled(self) -> Any:
        """The loop, ready to be called."""
        compilation = Compilation()
        names = {
            name: compilation.compiled(
                each.function, inline=not (name == "correct" and self._corrects_all_lanes)
            )
            for name, each in self.functions.items()
        }
        names |= {name: getattr(np, name) for name in ("zeros", "int64", "nan", "inf")}
        module: Any = compilation.module(self.source, **names, as_integers=as_integers)
        if not hasattr(module, "compiled"):
            module.compiled = njit(**OPTIONS, cache=True)(module.loop)
        return module.compiled

    @property
    def _corrects_all_lanes(self) -> bool:
        """Whether the bias is a kernel for all lanes, called between two loops over them."""
        return self.functions["correct"].takes_all_lanes

    @property
    def source(self) -> str:
        """The Python source of the loop."""
        step, correct = self.functions["step"], self.functions["correct"]
        advance = [*self.advance, *self._stepped(step)]
        constants, settle = [*self.constants], []
        if self._corrects_all_lanes:
            robot = self.n - self.targets
            advance += [*assign("x_next", "y", robot), *assign("force", "u_", self.m)]
            x = f"x[:{robot}]" if self.targets else "x"
            settle = [f"correct({x}, force, bias_parameters, correction)", f"for lane in range({LANES}):"]
            x_new = "x_next[{0}, lane] + correction[{0}, lane]"
            settle += [f"    {line}" for line in self._settled(x_new)]
        else:
            constants.append(correct.read("bias"))
            advance += [f"d = correct({self._x}, u_, bias_data)", *self._settled("y[{0}] + d[{0}]")]
        take = [self.take, f"for i in range({step.parameters}):"]
        take += ["    nominal[i, lane] = nominal_parameters[model, i]"]
        take += [f"for i in range({self.n_model_state}):", "    model_state[i, lane] = 0.0"]
        return fill(
            TEMPLATE,
            arguments=[self.arguments],
            rows=self._layout(),
            constants=constants,
            take=take,
            gather=[self.gather],
            advance=advance,
            judge=[self.judge],
            settle=settle,
            record=[self.record],
            release=[self.release],
        )

    @property
    def _x(self) -> str:
        """The text of the robot's states."""
        return f"x_[:{self.n - self.targets}]" if self.targets else "x_"

    def _stepped(self, step: Function) -> list[str]:
        """Lines of the nominal model's step, which set y."""
        if not self.n_model_state:
            return [f"y = step({self._x}, u_, {step.own('nominal')})"]
        state = tuple_of("model_state[{}, lane]", self.n_model_state)
        acted = "".join(f"model_state_next[{row}], " for row in self.acting)
        return [
            f"y, model_state_next = step({self._x}, u_, {step.own('nominal')}, {state})",
            *assign("model_state", "model_state_next", self.n_model_state),
            *([f"u_ = ({acted})"] if acted else []),  # for the bias
        ]

    def _settled(self, x_new: str) -> list[str]:
        """Lines that set the next state."""
        robot = self.n - self.targets
        targets = [f"x[{i}, lane]" for i in range(robot, self.n)]
        stays = f" + ({', '.join(targets)},)" if targets else ""
        return [f"x_new = {tuple_of(x_new, robot)}{stays}", *assign("x", "x_new", robot), *self.settle]

    def _layout(self) -> list[str]:
        """Lines that lay out all rows in one array of lanes, integers last."""
        integers = (*INTEGERS, *self.integers)
        two_loops = self._corrects_all_lanes
        sizes = {
            "x": self.n,
            "nominal": self.functions["step"].parameters,
            "model_state": self.n_model_state,
            "x_next": (self.n - self.targets) * two_loops,
            "correction": (self.n - self.targets) * two_loops,
            "force": self.m * two_loops,
            **self.rows,
            "integers": len(integers),
        }
        ends = list(accumulate(sizes.values()))
        parts = zip(sizes.items(), ends, strict=True)
        return [
            f"lanes = zeros(({ends[-1]}, {LANES}))",
            *(f"{name} = lanes[{end - size}:{end}]" for (name, size), end in parts),
            "integers = as_integers(integers)",
            *(f"{name} = integers[{row}]" for row, name in enumerate(integers)),
        ]


def fill(template: str, **blocks: Sequence[str]) -> str:
    """Replace the lines `{name}` of a template by lines of text, at the same indentation."""

    def block(match: re.Match[str]) -> str:
        lines = "\n".join(blocks[match["name"]]).splitlines()
        return "".join(f"{match['indent']}{line}\n" for line in lines if line.strip())

    return re.sub(r"^(?P<indent> *)\{(?P<name>\w+)\}\n", block, template, flags=re.MULTILINE)


def tuple_of(element: str, size: int, offset: int = 0) -> str:
    """The text of a tuple of `size` elements, each formatted with its index and its index plus an offset."""
    return f"({''.join(element.format(i, offset + i) + ', ' for i in range(size))})"


def sum_of(terms: Sequence[str]) -> str:
    """The text of the sum of terms, added pairwise, so that few additions wait for each other.

    Long sums in a kernel must be written out. If a loop indexes a long tuple, LLVM keeps that loop, and the
    whole closed loop is not vectorised.
    """
    if len(terms) < 2:
        return "".join(terms) or "0.0"
    half = len(terms) // 2
    return f"({sum_of(terms[:half])} + {sum_of(terms[half:])})"


def assign(rows: str, values: str, size: int) -> list[str]:
    """Lines that assign a tuple to a lane."""
    return [f"{rows}[{i}, lane] = {values}[{i}]" for i in range(size)]


def _constant(x, u, parameters):
    """The parameters themselves."""
    return parameters


def constant(values: Array) -> Kernel:
    """The kernel of a model, or of a bias, that returns these values (n,) everywhere."""
    return Kernel(_constant, values)


def in_threads(run: partial, count: int) -> None:
    """Call a compiled loop, run(begin, end, interrupted), for parts of range(count), on all threads.

    An exception in this thread, such as from Ctrl-C, sets `interrupted` (1,), and the loops end. This thread
    only waits, since Python handles signals between its instructions; the handover takes some 60 us.
    """
    interrupted = np.zeros(1, np.int64)
    threads = max(1, min(get_num_threads(), math.ceil(count / LANES)))  # threads with filled lanes
    if threads == 1 and count <= SHORT:
        run(0, count, interrupted)
        return
    cuts = [count * part // threads for part in range(threads + 1)]
    calls: list[Future] = []
    loop: Any = run.func
    if not loop.signatures:  # compile here, where a signal is handled
        run(0, 0, interrupted)
    try:
        for begin, end in pairwise(cuts):
            calls.append(_pool(threads).submit(run, begin, end, interrupted))
        for call in calls:
            call.result()
    finally:
        interrupted[0] = 1
        wait(calls)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Persistent threads: starting them takes as long as a generation of a short search."""
    return ThreadPoolExecutor(threads, "simbias")


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
