"""Loops as they are written for Numba, run by Python: to compile one takes longer than a few rollouts."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np

from simbias.core.records import Array, Rollout
from simbias.simulation import compiled, open_loop
from simbias.simulation.compiler import compile_closed_loop, compile_open_loop
from simbias.simulation.compiler.loop import Loop
from simbias.simulation.open_loop import PredictionModel, Windows, plain, predict


@contextmanager
def interpreted() -> Iterator[None]:
    """Within it, what would be compiled is the same text of the same kernels, without Numba."""
    closed, opened = (cache(loop.__wrapped__) for loop in (compile_closed_loop, compile_open_loop))
    with (
        patch.object(Loop, "compiled", _in_python),
        patch.object(compiled, "compile_closed_loop", closed),
        patch.object(open_loop, "compile_open_loop", opened),
        np.errstate(all="ignore"),
    ):
        yield


def _in_python(loop: Loop) -> Any:
    """The loop, as Python runs it."""
    names: dict[str, Any] = {name: each.function for name, each in loop.functions.items()}
    names |= {
        "zeros": np.zeros,
        "int64": np.int64,
        "as_integers": lambda rows: rows.view(np.int64),
        "nan": np.nan,
        "inf": np.inf,
    }
    exec(loop.source, names)
    names["loop"].signatures = ["any"]  # there is nothing to compile
    return names["loop"]


def predicted_as_plain(
    models: Sequence[PredictionModel], windows: Windows, rtol: float, atol: float = 0.0
) -> Array:
    """What the written loop predicts of recordings; it is what NumPy predicts."""
    with interpreted():
        made = predict(models, windows)
    np.testing.assert_allclose(made, plain(models, windows), rtol=rtol, atol=atol)
    return made


def assert_alike(
    made: Sequence[Rollout], expected: Sequence[Rollout], rtol: float, atol: float, of_inputs: float = 0.0
) -> None:
    """Rollouts are others, to these tolerances; of inputs the absolute one may be another."""
    for one, other in zip(made, expected, strict=True):
        assert (one.frames, one.failure) == (other.frames, other.failure)
        np.testing.assert_allclose(one.states, other.states, rtol=rtol, atol=atol)
        np.testing.assert_allclose(one.inputs, other.inputs, rtol=rtol, atol=of_inputs or atol)
