"""What runs in a sweep's workers."""

from __future__ import annotations

import pickle
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from records import assert_equal, timeless

import simbias
from simbias.config import Composition, compose
from simbias.core import SlowWarning
from simbias.sweep import worker
from simbias.sweep.worker import Plan, run_plan
from simbias.trial.run import Outcome, run_trial

SHORT = [
    *("task.horizon=400", "optimizer.max_evaluations=30", "method.max_iterations=2"),
    "cost.max_cost=1e-3",  # never reached
]
SCRIPT = """
import sys
from simbias.config import compose
from simbias.sweep.worker import Plan, run_plan

quick = ["task.horizon=100", "optimizer=cma", "optimizer.max_evaluations=20", "method.max_iterations=1"]
trial = compose(quick).trial
record = run_plan(Plan(trial.config, trial.choices, sys.argv[1], tuple(sys.argv[2:])))
names = [f"{name}.png" for name in sys.argv[2:]]
assert not record.reason and record.iterations and list(record.pictures) == names, record
heavy = {"pandas", "pyarrow", "mlflow", "rich", "sklearn", "matplotlib.pyplot"}
heavy |= {"scipy.optimize", "scipy.signal", "scipy.special", "scipy.stats"}
print(*heavy & set(sys.modules))
"""


@pytest.fixture
def trial() -> Composition:
    return compose(SHORT).trial


@pytest.mark.slow
@pytest.mark.parametrize("pictures", [(), ("overview",)], ids=["plain", "pictures"])
def test_a_worker_does_without_what_only_the_parent_needs(tmp_path: Path, pictures: tuple[str, ...]) -> None:
    """It saves a quarter of its memory, and half of its start."""
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "journal"), *pictures]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "\n"), done.stderr


def test_a_worker_sends_the_record_of_the_trial_without_fitted_biases(trial: Composition) -> None:
    record = run_plan(Plan(trial.config, trial.choices))
    assert record.outcome is Outcome.NOT_SUCCEEDED
    assert_equal(timeless(record), timeless(run_trial(simbias.load(SHORT))))
    assert [i.search.fitted_bias for i in record.iterations if i.search] == [None, None]
    assert_equal(pickle.loads(pickle.dumps(record)), record)


def test_a_worker_goes_on_with_what_its_journal_holds(trial: Composition, tmp_path: Path) -> None:
    whole = Plan(trial.config, trial.choices, str(tmp_path / "journal"))
    record = run_plan(whole)
    last = tmp_path / "journal" / "0005_experiment.npz"
    last.unlink()
    kept = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "journal").glob("0*")}
    assert len(kept) == 5
    assert_equal(timeless(run_plan(whole)), timeless(record))
    assert last.exists()
    assert kept.items() <= {p.name: p.stat().st_mtime_ns for p in last.parent.glob("0*")}.items()


def test_a_trial_that_cannot_begin_is_a_record_too(trial: Composition, tmp_path: Path) -> None:
    bad = {**trial.config, "bias": {"_target_": "simbias.learning.bias.gp.Nothing"}}
    record = run_plan(Plan(bad, trial.choices))
    assert (record.outcome, record.iterations, record.experiments) == (Outcome.ERROR, (), 0)
    assert record.reason.startswith("ConfigError: bias._target_: cannot import")
    assert record.started > 0
    (tmp_path / "file").touch()
    record = run_plan(Plan(trial.config, trial.choices, str(tmp_path / "file" / "journal")))
    assert record.outcome is Outcome.ERROR
    assert "cannot be written" in record.reason


def test_a_component_that_ends_the_process_as_it_is_built_ends_its_trial_only(
    trial: Composition, monkeypatch: pytest.MonkeyPatch
) -> None:
    def leave(*_: object, task: object) -> None:
        raise SystemExit("no licence")

    monkeypatch.setattr("simbias.learning.bias.gp.GaussianProcess.__init__", leave)
    config = {**trial.config, "bias": {"_target_": "simbias.learning.bias.gp.GaussianProcess"}}
    assert run_plan(Plan(config, trial.choices)).reason == "ConfigError: bias: no licence"


def test_no_line_for_each_slow_fit_of_each_trial(trial: Composition, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(composition: Composition) -> None:
        warnings.warn("slowly", SlowWarning, stacklevel=2)
        raise RuntimeError("far enough")

    monkeypatch.setattr(worker, "build", slow)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run_plan(Plan(trial.config, trial.choices)).reason == "RuntimeError: far enough"
