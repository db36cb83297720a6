"""What runs in a sweep's workers, and how a trial's folder travels where they share no disk."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
from sweeping import content

from simbias.config import Composition, compose
from simbias.config.build import build
from simbias.core import SlowWarning
from simbias.sweep import worker
from simbias.sweep.worker import Plan, code, pack, run_plan, unpack
from simbias.trial.folder import OUTCOME, TrialFolder
from simbias.trial.run import Outcome

SHORT = [
    *("task.horizon=200", "optimizer.max_evaluations=20", "method.max_iterations=2", "tracking=none"),
    "cost.max_cost=1e-3",  # never reached
]
SCRIPT = """
import sys
from simbias.config import compose
from simbias.sweep.worker import Plan, run_plan

quick = ["task.horizon=100", "optimizer=cma", "optimizer.max_evaluations=20", "method.max_iterations=1"]
assert run_plan(Plan(compose(quick).trial, sys.argv[1])).summary.iterations
heavy = {"pandas", "pyarrow", "mlflow", "rich", "sklearn", "matplotlib"}
print(*(heavy | {"scipy.optimize", "scipy.signal", "scipy.special", "scipy.stats"}) & set(sys.modules))
"""


@pytest.fixture(scope="module")
def trial() -> Composition:
    return compose(SHORT).trial


@pytest.fixture
def plan(trial: Composition, tmp_path: Path) -> Plan:
    """A trial in a folder."""
    return Plan(trial, str(tmp_path / "trial"))


@pytest.fixture(scope="module")
def whole(trial: Composition, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the trial, ended."""
    folder = tmp_path_factory.mktemp("whole") / "trial"
    result = run_plan(Plan(trial, str(folder)))
    assert (result.summary.outcome, result.packed) == (Outcome.NOT_SUCCEEDED, b"")
    return folder


@pytest.mark.slow
def test_a_worker_does_without_what_only_the_parent_needs(tmp_path: Path) -> None:
    """It saves a quarter of its memory, and half of its start."""
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "trial")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "\n"), done.stderr


def test_a_worker_of_another_version_runs_no_trial(plan: Plan, trial: Composition) -> None:
    build(trial)
    same = code(trial)
    result = run_plan(plan._replace(code={**same, "simbias": "another"}))
    assert result.summary.reason.startswith("simbias has other code there")
    assert not Path(str(plan.folder)).exists()
    assert not run_plan(plan._replace(code={**same, "loaded_later": ""})).summary.reason


def test_a_folder_travels_where_no_disk_is_shared(plan: Plan, whole: Path, tmp_path: Path) -> None:
    """There and back: the worker gets what is kept, makes the rest, and sends all; it needs no folder."""
    folder, there = tmp_path / "trial", tmp_path / "another machine"
    unpack(pack(whole), folder)
    for file in (folder / OUTCOME, *TrialFolder(folder).steps()[5:]):  # as if killed after the fifth step
        file.unlink()
    begun = len(TrialFolder(folder).attempts())
    result = run_plan(plan._replace(folder=str(there), marker=str(tmp_path / "no such"), kept=pack(folder)))
    assert [len(TrialFolder(each).attempts()) for each in (folder, there)] == [begun, begun + 1]
    unpack(result.packed, folder)
    assert content(folder) == content(there) == content(whole)
    alone = run_plan(plan._replace(folder=None)).summary
    assert (alone.test_episodes, alone.experiments) == ("", result.summary.experiments)
    marker = tmp_path / "marker"
    marker.touch()
    assert not run_plan(plan._replace(marker=str(marker))).packed


def test_an_outcome_that_somebody_damaged_follows_from_the_steps(whole: Path, plan: Plan) -> None:
    folder = Path(str(plan.folder))
    unpack(pack(whole), folder)
    kept = json.loads((whole / OUTCOME).read_text())
    for damage in ("", "{", "[]", "{}", json.dumps(kept | {"experiments": "many"})):
        (folder / OUTCOME).write_text(damage)
        assert run_plan(plan).summary.outcome is Outcome.NOT_SUCCEEDED, damage
        assert content(folder) == content(whole)


def with_bias(plan: Plan, target: str) -> Plan:
    config = {**plan.composition.config, "bias": {"_target_": target}}
    return plan._replace(composition=replace(plan.composition, config=config))


def test_a_trial_that_cannot_begin_is_a_result_too(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    summary = run_plan(with_bias(plan, "simbias.learning.bias.gp.Nothing")).summary
    assert (summary.outcome, summary.experiments) == (Outcome.ERROR, 0)
    assert summary.reason.startswith("ConfigError: bias._target_: cannot import")
    (tmp_path / "file").touch()
    summary = run_plan(plan._replace(folder=str(tmp_path / "file" / "trial"))).summary
    assert summary.outcome is Outcome.ERROR
    assert "cannot be written" in summary.reason

    def leave(*_: object, task: object) -> None:
        raise SystemExit("no licence")

    monkeypatch.setattr("simbias.learning.bias.gp.GaussianProcess.__init__", leave)
    plan = with_bias(plan, "simbias.learning.bias.gp.GaussianProcess")
    assert run_plan(plan).summary.reason == "ConfigError: bias: no licence"


def test_no_line_for_each_slow_fit_of_each_trial(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(composition: Composition) -> None:
        warnings.warn("slowly", SlowWarning, stacklevel=2)
        raise RuntimeError("far enough")

    monkeypatch.setattr(worker, "build", slow)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run_plan(plan).summary.reason == "RuntimeError: far enough"
