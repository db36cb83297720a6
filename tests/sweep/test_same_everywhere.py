"""A trial has the same bits wherever it runs on one kind of machine; on another kind, it says so."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import PYTHONPATH
from sweeping import content

from simbias.config import compose
from simbias.engine.contract import Engine
from simbias.engine.loky import Loky
from simbias.engine.sequential import Sequential
from simbias.sweep.worker import Plan, run_plan

pytestmark = pytest.mark.slow

SHORT = [
    *("tracking=none", "task.horizon=200", "optimizer.max_evaluations=15", "method.max_iterations=2"),
    "cost.max_cost=1e-3",  # never reached: all iterations learn
]
TRIALS = [  # what learns, searches and samples differently
    ["optimizer=cma", "hardware.record=measured", "hardware.noise.torque_variance=0.1"],
    [
        *("preset=robust", "bias=none", "evaluation.rollouts=3", "evaluation.seconds=0.2"),
        *("identification.starts=2", "identification.rounds=1"),
    ],
]
ELSEWHERE = "from test_same_everywhere import *; print(*digests(Sequential(), Path(sys.argv[1])))"


def digests(engine: Engine, folder: Path, backwards: bool = False) -> list[str]:
    """Of every trial's folder, in the order of TRIALS."""
    folder.mkdir(exist_ok=True)
    trials = [compose([*SHORT, *trial, f"seed={seed}"]).trial for seed, trial in enumerate(TRIALS)]
    plans = [Plan(each, str(folder / str(i))) for i, each in enumerate(trials)]
    for _, result in engine.run(run_plan, plans[::-1] if backwards else plans):
        assert result.summary.outcome.final, result.summary.reason  # type: ignore[union-attr]
    return [hashlib.sha256(repr(content(Path(str(plan.folder)))).encode()).hexdigest() for plan in plans]


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    found = digests(Sequential(), tmp_path_factory.mktemp("here"))
    assert len(set(found)) == len(TRIALS)
    return found


def test_engines_and_jobs_change_no_bit(expected: list[str], tmp_path: Path) -> None:
    """Nor does the order: they run backwards here. Dask's are in `tests/engine/test_sweeps.py`."""
    assert digests(Loky(n_jobs=2), tmp_path / "loky", backwards=True) == expected


def test_hash_seeds_and_threads_change_no_bit(expected: list[str], tmp_path: Path) -> None:
    """Here linear algebra has one thread, and here and in the workers above hash seeds are random."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "4")
    path = {"PYTHONPATH": f"{PYTHONPATH}:{Path(__file__).parent}", "PYTHONHASHSEED": "2015"}
    made = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, str(tmp_path)],
        env=os.environ | path | threads,
        stdout=subprocess.PIPE,
        text=True,
        timeout=120,
        check=True,
    )
    assert made.stdout.split() == expected
