"""A trial has the same bits wherever it runs on one kind of machine; on another kind, it says so."""

import hashlib
from pathlib import Path

import pytest
from sweeping import content
from threadpoolctl import threadpool_limits

from simbias.config import compose
from simbias.engine.contract import Engine
from simbias.engine.loky import Loky
from simbias.engine.sequential import Sequential
from simbias.sweep.worker import PlannedTrial, run_plan

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


def digests(engine: Engine, folder: Path, backwards: bool = False) -> list[str]:
    """Of every trial's folder, in the order of TRIALS."""
    folder.mkdir(exist_ok=True)
    trials = [compose([*SHORT, *trial, f"seed={seed}"]).trial for seed, trial in enumerate(TRIALS)]
    plans = [PlannedTrial(each, str(folder / str(i))) for i, each in enumerate(trials)]
    for _, result in engine.run(run_plan, plans[::-1] if backwards else plans):
        assert result.summary.outcome.final, result.summary.reason  # type: ignore[union-attr]
    return [hashlib.sha256(repr(content(Path(str(plan.folder)))).encode()).hexdigest() for plan in plans]


def test_no_engine_job_order_hash_seed_or_thread_changes_a_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers run them backwards, with another hash seed. Dask's are in `tests/engine/test_sweeps.py`."""
    expected = digests(Sequential(), tmp_path / "here")
    assert len(set(expected)) == len(TRIALS)
    with threadpool_limits(4, user_api="blas"):
        assert digests(Sequential(), tmp_path / "threads") == expected
    monkeypatch.setenv("PYTHONHASHSEED", "2015")
    assert digests(Loky(n_jobs=2), tmp_path / "loky", backwards=True) == expected
