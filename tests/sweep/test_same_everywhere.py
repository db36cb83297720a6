"""A trial has the same bits wherever it runs on one kind of machine; on another kind, it says so."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

from simbias.config import compose
from simbias.engine.contract import Engine
from simbias.engine.dask import Dask
from simbias.engine.loky import Loky
from simbias.engine.sequential import Sequential
from simbias.sweep.worker import Plan, run_plan
from simbias.trial.run import TrialRecord

pytestmark = pytest.mark.slow

SHORT = [
    *("tracking=none", "task.horizon=400", "optimizer.max_evaluations=30", "method.max_iterations=2"),
    "cost.max_cost=1e-3",  # never reached: all iterations learn
]
TRIALS = [  # what learns, searches and samples differently
    ["bias=gp", "hardware.noise.torque_variance=0.1"],
    ["bias=sparse_gp", "optimizer=hybrid", "hardware.inertia_error=0.2"],
    ["bias=gp_learned", "optimizer=cma", "hardware.record=measured", "hardware.noise.angle_variance=1e-6"],
    ["preset=robust", "hardware.noise.torque_variance=0.1", "evaluation.rollouts=4", "evaluation.seconds=1"],
]
FORGOTTEN = ("started", "seconds", "processor", "machines", "fitted_bias")
ELSEWHERE = "from test_same_everywhere import *; print(*digests(Sequential()))"


def plans() -> list[Plan]:
    composed = [compose([*SHORT, *trial, f"seed={seed}"]) for seed, trial in enumerate(TRIALS)]
    return [Plan(each.config, each.choices) for each in composed]


def parts(thing: Any) -> Iterator[bytes]:
    """All bits of a record but those of times."""
    if isinstance(thing, np.ndarray):
        yield f"{thing.dtype} {thing.shape}".encode() + thing.tobytes()
    elif is_dataclass(thing):
        for field in fields(thing):
            if field.name not in FORGOTTEN:
                yield field.name.encode()
                yield from parts(getattr(thing, field.name))
    elif isinstance(thing, tuple | list):
        for each in thing:
            yield from parts(each)
    elif isinstance(thing, Mapping):
        for key, value in thing.items():
            yield key.encode()
            yield from parts(value)
    else:
        yield repr(thing).encode()


def digest(record: TrialRecord) -> str:
    assert record.outcome.final, record.reason
    return hashlib.sha256(b"|".join(parts(record))).hexdigest()


def digests(engine: Engine, backwards: bool = False) -> list[str]:
    """Of every trial, in the order of TRIALS."""
    todo = plans()[::-1] if backwards else plans()
    found = {index: digest(record) for index, record in engine.run(run_plan, todo)}  # type: ignore[arg-type]
    ordered = [found[index] for index in range(len(todo))]
    return ordered[::-1] if backwards else ordered


@pytest.fixture(scope="module")
def expected() -> list[str]:
    found = digests(Sequential())
    assert len(set(found)) == len(TRIALS)
    return found


def elsewhere(**environment: str) -> list[str]:
    """As a process of its own finds them."""
    path = os.pathsep.join(map(str, [ROOT, ROOT / "tests", ROOT / "tests" / "sweep"]))
    made = subprocess.run(
        [sys.executable, "-c", ELSEWHERE],
        env=os.environ | {"PYTHONPATH": path} | environment,
        stdout=subprocess.PIPE,
        text=True,
        timeout=120,
        check=True,
    )
    return made.stdout.split()


@pytest.mark.parametrize("engine", [Loky(n_jobs=3), Dask(n_jobs=2)], ids=["loky", "dask"])
def test_engines_and_jobs_change_no_bit(engine: Engine, expected: list[str]) -> None:
    if isinstance(engine, Dask):
        pytest.importorskip("distributed")
    assert digests(engine) == expected


def test_the_order_changes_no_bit(expected: list[str]) -> None:
    assert digests(Sequential(), backwards=True) == expected


def test_hash_seeds_and_threads_change_no_bit(expected: list[str]) -> None:
    """Here linear algebra has one thread, and here and in the workers above hash seeds are random."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    assert elsewhere(PYTHONHASHSEED="2015", **dict.fromkeys(names, "4")) == expected
