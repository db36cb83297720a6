"""What runs in a sweep's workers, and how a trial's folder travels where they share no disk."""

from dataclasses import replace
from importlib import import_module
from io import BytesIO
from pathlib import Path
from socket import gethostname
from unittest.mock import Mock
from zipfile import ZipFile

import pytest
from errors import one_line
from sweeping import content
from texts import write

from simbias.config import Composition, compose
from simbias.config.build import build
from simbias.engine.contract import WorkplaceError
from simbias.sweep.worker import PlannedTrial, code, pack, run_plan, unpack
from simbias.trial.folder import OUTCOME, TRIAL, TrialFolder
from simbias.trial.run import Outcome

SHORT = [
    *("task.horizon=200", "optimizer.max_evaluations=20", "method.max_iterations=2", "tracking=none"),
    "cost.max_cost=1e-3",  # never reached
]


@pytest.fixture(scope="module")
def trial() -> Composition:
    return compose(SHORT).trial


@pytest.fixture
def plan(trial: Composition, tmp_path: Path) -> PlannedTrial:
    """A trial in a folder."""
    return PlannedTrial(trial, str(tmp_path / "trial"))


@pytest.fixture(scope="module")
def whole(trial: Composition, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the trial, ended."""
    folder = tmp_path_factory.mktemp("whole") / "trial"
    result = run_plan(PlannedTrial(trial, str(folder)))
    assert (result.summary.outcome, result.packed) == (Outcome.NOT_SUCCEEDED, b"")
    return folder


def test_a_worker_of_another_version_runs_no_trial(
    plan: PlannedTrial, trial: Composition, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor does one whose disk is full, that lacks a module, or that finds another file."""
    same = code(build(trial))
    other = plan._replace(code={**same, "simbias": "another"})
    lacking = with_bias(plan, "simbias.learning.bias.gp.Nothing")._replace(code=same)
    differs = r"code or files differ from those where the sweep was started \(simbias\)"
    words = rf"{differs} \(on {gethostname()}, ", "bias._target_: cannot import"
    for unfit, said in zip((other, lacking), words, strict=True):
        with one_line(said, WorkplaceError):
            run_plan(unfit)
    with monkeypatch.context() as patch:
        patch.setattr("simbias.sweep.worker.ROOM", 10**18)
        with one_line(r"OSError: \[Errno 28\] less than .* free: .* \(on [^;]*$", WorkplaceError):
            run_plan(plan._replace(code=same, marker="not here"))
    with monkeypatch.context() as patch:
        patch.setattr("simbias.learning.bias.gp.GaussianProcess.source_files", ["gains.csv"], raising=False)
        patch.chdir(tmp_path)
        write(tmp_path, {"gains.csv": "1"})
        reads = plan._replace(code=code(build(trial)))
        write(tmp_path, {"gains.csv": "2"})
        with one_line(rf"differ .* \({tmp_path.name}/gains.csv\)", WorkplaceError):
            run_plan(reads)
    assert not Path(str(plan.folder)).exists()
    assert run_plan(plan._replace(code={**same, "loaded_later": ""})).summary.outcome.final


@pytest.mark.slow
def test_a_folder_travels_where_no_disk_is_shared(
    plan: PlannedTrial, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There and back: the worker gets what is kept, makes the rest, and sends all; only that counts."""
    folder, there = tmp_path / "trial", tmp_path / "another machine"
    with ZipFile(BytesIO(pack(whole))) as packed:  # killed while it is laid out, it can be resumed
        assert [packed.namelist()[index] for index in (0, -1)] == [TRIAL, OUTCOME]
    unpack(pack(whole), folder)
    for file in (folder / OUTCOME, *TrialFolder(folder).steps()[5:]):  # as if killed after the fifth step
        file.unlink()
    begun = len(TrialFolder(folder).attempts())
    unpack(pack(whole), there)  # of an earlier sweep: what has been moved away since counts no longer
    result = run_plan(plan._replace(folder=str(there), marker=str(tmp_path / "no such"), kept=pack(folder)))
    unpack(result.packed, folder)
    assert len(TrialFolder(folder).attempts()) == begun + 1
    assert content(folder) == content(whole)
    alone = run_plan(plan._replace(folder=None)).summary
    assert (alone.test_episodes, alone.experiments) == ("", result.summary.experiments)
    with ZipFile(outside := BytesIO(), "w") as archive:
        archive.writestr("../outside.txt", "")
    with one_line("a worker sent '../outside.txt', which would lie outside"):
        unpack(outside.getvalue(), folder)
    assert not (tmp_path / "outside.txt").exists()
    with monkeypatch.context() as patch:
        patch.setattr("simbias.search.optimizer.nlopt.Nlopt.search", Mock(side_effect=RuntimeError))
        raised = run_plan(plan._replace(marker=str(tmp_path / "no such")))
    unpack(raised.packed, tmp_path / "raised")
    assert raised.summary.traceback_file == str(folder / "error_0000.txt")
    assert (tmp_path / "raised" / "error_0000.txt").exists()
    marker = tmp_path / "marker"
    marker.touch()
    assert not run_plan(plan._replace(marker=str(marker))).packed


def with_bias(plan: PlannedTrial, target: str) -> PlannedTrial:
    config = {**plan.composition.config, "bias": {"_target_": target}}
    return plan._replace(composition=replace(plan.composition, config=config))


def test_a_trial_that_cannot_begin_is_a_result_too(
    plan: PlannedTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "licensed.py").write_text("def build(composition): raise RuntimeError('no licence')\n")
    monkeypatch.syspath_prepend(tmp_path)
    with monkeypatch.context() as patch:  # as by a constructor
        patch.setattr("simbias.sweep.worker.build", import_module("licensed").build)
        own = run_plan(plan)
    assert own.summary.reason == "RuntimeError: no licence"
    assert "licensed.py" in own.traceback
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
