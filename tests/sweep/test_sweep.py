"""What a sweep runs, keeps and tells."""

from __future__ import annotations

import io
import json
import math
import re
import shutil
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import OWN_CONF, POINT_MASS, ROOT
from mlflow import MlflowClient
from rich.console import Console
from sweeping import NO_FIGURES, QUICK, artifacts, everything, run, runs, table, trial_by_trial, write_sweep

import simbias
from simbias.__main__ import main
from simbias.config import ConfigError, compose, sweeps
from simbias.config.build import build
from simbias.engine.contract import Engine
from simbias.mlflow import fields, results
from simbias.mlflow.mlflow_sweep import MlflowSweep
from simbias.mlflow.mlflow_trial import MlflowTrial
from simbias.sweep.axes import read_axis
from simbias.sweep.grid import Sweep, Trial, expand
from simbias.sweep.running import SweepObserver
from simbias.sweep.services import tracking
from simbias.sweep.tables import cells, interval, layout, legend, markdown
from simbias.sweep.worker import Plan, run_plan
from simbias.terminal.notices import COMPILING
from simbias.terminal.sweep import SweepConsole
from simbias.trial.run import Outcome, TrialRecord

pytestmark = pytest.mark.slow


class Backwards(Engine):
    """One trial after the other, the last first."""

    def run(self, function: Any, tasks: Any) -> Any:
        for index in reversed(range(len(tasks))):
            yield index, function(tasks[index])


@pytest.fixture
def folder(new_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copy(new_store, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def store(folder: Path) -> str:
    """An absolute URI: in one process MLflow keeps what a relative one meant at first."""
    return f"tracking.uri=sqlite:///{folder}/mlflow.db"


@pytest.mark.parametrize("name", [name for name in sweeps() if not name.startswith("fig")])  # tests/figures
def test_every_sweep_runs_shortened(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = compose([f"+sweep={name}"]).config  # not expanded: that takes as long as the trials
    axes = [read_axis(*axis) for axis in base["sweep"]["axes"].items()]
    swept = {key for axis in axes for key in axis.keys}
    wanted = {"evaluation.seconds": 0.2, "method.lqr_candidates": 1}
    known = {f"{group}.{key}" for group in ("evaluation", "method") for key in base[group]}
    shorter = [
        f"{key}={value}" for key, value in wanted.items() if key in known and key.split(".")[0] not in swept
    ]
    assert (
        main(
            [
                f"+sweep={name}",
                "sweep.trials=1",
                *QUICK,
                *("method.max_iterations=1", "optimizer.max_evaluations=5"),
                *("held_out.lasting=0", "held_out.starts=1"),
                *shorter,
                "tracking=none",
                "engine=sequential",
            ]
        )
        == 0
    )
    out = capsys.readouterr().out
    cells = math.prod(len(axis.values) for axis in axes)
    assert f"{cells} cells x 1 trials = {cells}" in out
    assert f"[{cells}/{cells}]" in out
    assert ("the paper's" in out.partition("experiments: ")[2]) == (
        "paper" in base["sweep"].get("report", {})
    )
    assert not (folder / "mlartifacts").exists()


def test_jobs_and_order_change_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parent)
    engines = {
        "one": ["engine.n_jobs=1"],
        "two": ["engine.n_jobs=2"],
        "backwards": ["engine=sequential", "engine._target_=test_sweep.Backwards", "--allow", "test_sweep"],
    }
    quick = ["+sweep=smoke", NO_FIGURES, "optimizer.max_evaluations=15", "tracking.pictures=false"]
    found = {}
    for name, overrides in engines.items():
        (folder / name).mkdir()
        shutil.copy(folder / "mlflow.db", folder / name)
        assert main([*quick, *overrides, store(folder / name)]) == 0
        found[name] = (trial_by_trial(folder / name), table(folder / name))
    assert found["one"] == found["two"] == found["backwards"]
    assert len(found["one"][0]) == 4
    single_is_the_same(folder, found["one"][0])


def single_is_the_same(folder: Path, swept: dict[str, Any]) -> None:
    """The same config as a trial of its own leaves the same metrics and files."""
    values = ["task.horizon=300", "optimizer.max_evaluations=15", "method.max_iterations=2"]
    values.append("tracking.pictures=false")
    trial = expand(["+sweep=smoke", "optimizer.max_evaluations=15"]).trials[1]
    assert main([*values, "hardware.inertia_error=0.2", f"seed={trial.seed}", store(folder)]) in (0, 1)
    client = MlflowClient(tracking_uri=f"sqlite:///{folder}/mlflow.db")
    experiment = client.get_experiment_by_name("simbias")
    assert experiment is not None
    (single,) = client.search_runs([experiment.experiment_id])
    assert single.data.tags["hash"] == trial.hash
    assert everything(client, single) == swept[trial.hash]


def test_the_parent_tells_everything(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noise = "sweep.axes.noise.values=[[0.0,0.0,0.0],[0.1,0.0,0.0]]"
    again = ["+sweep=table2", "sweep.trials=1", *QUICK, noise, "engine=sequential", store(folder)]
    assert main(again) == 0
    out = capsys.readouterr().out
    (parent,), trials = runs(folder)
    assert parent.info.status == "FINISHED"
    note = parent.data.tags["mlflow.note.content"]
    assert "**Done**: 4 of 4 [trials](#/experiments/" in note
    assert "| torque variance | angle variance | velocity variance | no error: experiments |" in note
    assert parent.data.metrics["experiments/mean"] == np.mean(
        [t.data.metrics["experiments/total"] for t in trials]
    )
    assert "| 0.1 | 0 | 0 | 2.0 | 1/1 | 5.5 | 2.0 | 1/1 | 2.5 |" in note
    assert (artifacts(parent) / "table.md").read_text() in note + "\n"
    assert "     0.1         0         0" in out
    frame = pd.read_csv(artifacts(parent) / "table.csv")
    assert list(frame["paper"]) == [6.4, 2.8, 5.5, 2.5]
    one_by_one = pd.read_csv(artifacts(parent) / "trials.csv")
    assert set(one_by_one["hash"]) == {trial.data.tags["hash"] for trial in trials}
    assert "error:\n" in (artifacts(parent) / "sweep.yaml").read_text()
    assert (artifacts(parent) / "figures" / "table2.png").stat().st_size > 5000
    client = MlflowClient(tracking_uri=f"sqlite:///{folder}/mlflow.db")
    logged = pd.read_json(artifacts(parent) / "table.json", orient="split")
    assert list(logged["paper"]) == [6.4, 2.8, 5.5, 2.5]
    assert json.loads(parent.data.tags["mlflow.loggedArtifacts"]) == [{"path": "table.json", "type": "table"}]
    for trial in trials:
        assert trial.data.tags["axis.error"] in ("no error", "20% error")
        assert trial.info.end_time - trial.info.start_time >= 10
        assert client.get_metric_history(trial.info.run_id, "cost/hardware_max")[0].step == 0
        assert (artifacts(trial) / "experiments" / "iteration_00_experiment_1.npz").exists()
    assert main(again) == 0  # nothing is missing
    assert len(pd.read_json(artifacts(parent) / "table.json", orient="split")) == 4
    assert len(runs(folder)[1]) == 4


def test_last_policies_are_tried_and_told(folder: Path) -> None:
    """By the workers, after the trials; table, metrics and files tell of it, also when read again."""
    tries = ["held_out.starts=3", "held_out.lasting=1", "held_out.seconds=0.4"]
    told = "+sweep.report.measures=[experiments,hardware_seconds,held,reliable,lasted]"
    again = ["+sweep=smoke", NO_FIGURES, *QUICK, *tries, told, "tracking.pictures=false", store(folder)]
    trials = simbias.run_sweep(again)
    assert set(trials["held_out"]) == {"111"}  # nobody falls within 0.2 s
    frames = [len(each) for each in _experiments(folder)]
    assert trials["hardware_seconds"].sum() == pytest.approx(0.001 * sum(frames))
    (parent,), kept = runs(folder)
    assert "| 100% | 100% | 100% |" in (artifacts(parent) / "table.md").read_text()
    assert "held: mean share of 3 held-out starts" in parent.data.tags["mlflow.note.content"]
    for trial in kept:
        assert trial.data.metrics["held_out/held"] == 1.0
        assert trial.data.metrics["held_out/seconds"] == pytest.approx(0.4)
        assert "Its last policy holds 3 of 3 held-out starts" in trial.data.tags["mlflow.note.content"]
        rows = pd.read_csv(artifacts(trial) / "held_out.csv")
        assert list(rows["lasted_seconds"]) == pytest.approx([0.4, 0.2, 0.2])
    pd.testing.assert_frame_equal(simbias.run_sweep(again), trials, check_exact=False)


def _experiments(folder: Path) -> list[Any]:
    """The inputs of all experiments that a store holds."""
    return [
        np.load(file)["inputs"]
        for trial in runs(folder)[1]
        for file in (artifacts(trial) / "experiments").iterdir()
    ]


def test_what_is_read_is_what_was_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And what could not be written in full is as if it had never been."""
    sweep = expand(["+sweep=smoke", *QUICK, store(folder)])
    first, second, *_ = sweep.trials
    record = run_plan(plan(first))
    store_of_trials = tracking(sweep.base)
    tracked = store_of_trials.open_sweep(sweep, "again")
    tracked.keep(first, build(first.composition), record)
    raised = TrialRecord(
        Outcome.ERROR, (), reason="ValueError: no", traceback="Trace", started=1.0, seconds=2.0
    )
    tracked.keep(second, build(second.composition), raised)
    wanted = [
        results.row(trial, sweep, each.outcome, fields.trial_metrics(each), each.reason)
        for trial, each in ((first, record), (second, raised))
    ]
    found = tracked.results().to_dict("records")
    for row, expected in zip(found, wanted, strict=True):
        assert row["seconds"] == pytest.approx(expected["seconds"], abs=0.01)
        assert row.pop("run_id")
        row["seconds"] = expected["seconds"]
        assert {**expected, "run_id": 0} == pytest.approx({**row, "run_id": 0}, nan_ok=True)
    tracked.close(OSError("the disk is full"))
    assert runs(folder)[0][0].info.status == "FAILED"
    tracked = store_of_trials.open_sweep(sweep, "again")
    assert tracked.finished == {first.hash}
    tracked.keep(second, build(second.composition), raised)
    kept = tracked.results()
    tracked.close()
    tracked = store_of_trials.open_sweep(sweep, "again")
    pd.testing.assert_frame_equal(tracked.results(), kept)
    assert list(kept["seconds"])[1] == 4.0  # of both attempts
    monkeypatch.setattr(MlflowTrial, "_flush", full_disk)
    with pytest.raises(OSError, match="full"):
        tracked.keep(second, build(second.composition), record)
    assert list(tracked.results()["hash"]) == [first.hash]
    monkeypatch.undo()
    tracked.close()
    tracked = store_of_trials.open_sweep(sweep, "again")
    tracked.keep(second, build(second.composition), record)
    assert list(tracked.results()["outcome"]) == [record.outcome] * 2
    assert len(runs(folder)[1]) == 2
    tracked.close()


def plan(trial: Trial) -> Plan:
    return Plan(trial.composition.config, trial.composition.choices)


def full_disk(*_: Any) -> None:
    raise OSError("the disk is full")


def test_dry_run_runs_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "elsewhere").mkdir()
    elsewhere = f"tracking.uri=sqlite:///{folder}/elsewhere/mlflow.db"
    assert main(["+sweep=smoke", "sweep.dry_run=true", elsewhere]) == 0
    (said,) = capsys.readouterr().out.splitlines()[4:]
    assert said.startswith("smoke: 0 of 4 trials are finished; the others may take ")
    assert " on 2 jobs if each first policy succeeds, " in said
    assert " if none does (rough: as fast as this machine simulates" in said
    assert not list((folder / "elsewhere").iterdir())
    quick = ["sweep.trials=1", "engine=sequential", "tracking.pictures=false", NO_FIGURES]
    assert main(["+sweep=smoke", *quick, store(folder)]) == 0
    capsys.readouterr()
    assert main(["+sweep=smoke", "sweep.dry_run=true", store(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:4]] == ["finished", "finished", "missing", "missing"]
    assert lines[4].startswith(
        "smoke: 2 of 4 trials are finished; the others may take less than 1 s on 2 jobs (from 2 "
    )
    assert len(runs(folder)[1]) == 2


RAISING = """
from simbias.robots.bongoboard.pymunk import PymunkBongoboard

class Hot(PymunkBongoboard):
    def run(self, policy, theta, start, rng):
        if start[0] > THRESHOLD:
            raise RuntimeError("the motor is | hot")
        return super().run(policy, theta, start, rng)
"""


def test_a_trial_that_raises(folder: Path) -> None:
    """It is recorded with its error, the others run; when the fault is mended, it goes on in its run."""
    conf = write_sweep(folder, "mine", "sweep: {trials: 4, axes: {bias: [gp, none]}}")
    (conf / "hardware").mkdir()
    (conf / "hardware" / "hot.yaml").write_text("_target_: hot.Hot\nnoise: {}\n")
    module = folder / "hot.py"
    command = ["--config-dir", "conf", "+sweep=mine", "hardware=hot", *QUICK]
    command.append("tracking.pictures=false")
    module.write_text(RAISING.replace("THRESHOLD", "0.01"))
    status, out, err = run(*command, folder=folder)
    assert status == 1, out + err
    (parent,), trials = runs(folder)
    failed = [trial for trial in trials if trial.info.status == "FAILED"]
    assert 0 < len(failed) < 8
    assert len(trials) == 8
    assert parent.info.status == "FAILED"
    assert f"{len(failed)} trials raised an error" in out
    assert "raised HardwareError: Hot.run: expected a Rollout, got RuntimeError: the motor is | hot" in out
    assert "raised" in parent.data.tags["mlflow.note.content"]
    for trial in failed:
        assert "the motor is | hot" in trial.data.tags["error"]
        assert 'raise RuntimeError("the motor is | hot")' in (artifacts(trial) / "error.txt").read_text()
    module.write_text(RAISING.replace("THRESHOLD", "9.0"))
    status, out, err = run(*command, "engine=sequential", folder=folder)
    assert status == 0
    assert re.fullmatch(
        r"simbias: \d of \d finished trials ran on code that has changed .*\(hot\); .*\n", err
    )
    assert f"mine: 2 cells x 4 trials = 8, {8 - len(failed)} of them finished already" in out
    assert len(trial_by_trial(folder)) == 8


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["+sweep=nosuch"], "sweep=nosuch: no such option; sweep has ablation, "),
        (["+sweep=smoke", "bias.d=abc"], "bias.d: must be a valid number"),
        (["+sweep=smoke", "+sweep.axes.bias.d=[1, -1]"], "sweep.axes.bias: must be a list of values"),
        (["+sweep=smoke", "+sweep.axes.x={keys: bias.d, values: [1, -1]}"], "bias.d: must be greater than 0"),
        (["+sweep=smoke", "engine.n_jobs=0"], "engine.n_jobs: must be greater than 0, got 0"),
        (["+sweep=smoke", "engine=nosuch"], "engine=nosuch: no such option; engine has dask, loky"),
        (["engine.n_jobs=x"], "engine.n_jobs: must be a valid integer"),
    ],
)  # fmt: skip
def test_bad_input_runs_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], overrides: list[str], message: str
) -> None:
    assert main(overrides) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err.splitlines()) == 1
    assert not (folder / "mlartifacts").exists()


def test_overhead_of_a_trial(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What keeping a trial with as much data as the paper's longest costs, in processor time of its thread.

    Not as the difference of whole sweeps: other tests' threads and a busy machine would count too.
    """
    keep, seconds = MlflowSweep.keep, []

    def timed(*arguments: Any) -> None:
        began = time.thread_time()
        keep(*arguments)
        seconds.append(time.thread_time() - began)

    monkeypatch.setattr(MlflowSweep, "keep", timed)
    long = ["method.max_iterations=10", "optimizer.max_evaluations=3", "hardware.feet=separate"]
    quick = ["+sweep=smoke", "engine=sequential", "task.horizon=5000", *long, "tracking.pictures=false"]
    assert main([*quick, "sweep.trials=3", store(folder)]) == 0
    trials = runs(folder)[1]
    assert len(trials) == len(seconds) == 6
    assert all(trial.data.metrics["experiments/total"] == 20 for trial in trials)
    print(f"overhead of a trial: {np.median(seconds):.3f} s")
    assert np.median(seconds) < 0.3


MEMORY = """
import resource, sys
from simbias.__main__ import main
command = ["--config-dir", sys.argv[1], *sys.argv[2:]]
assert main([*command, "sweep.trials=4"]) == 0
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
assert main([*command, "sweep.trials=24"]) == 0
print("more MiB:", (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""


def test_parents_memory_is_flat(folder: Path) -> None:
    """40 trials more, whose rollouts alone are 5 MiB when unpacked."""
    small = ["task.horizon=500", "tracking.pictures=false"]
    done = subprocess.run(
        [sys.executable, "-c", MEMORY, str(ROOT / "conf"), "+sweep=smoke", *QUICK, *small],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    more = float(done.stdout.splitlines()[-1].split()[-1])
    print(f"40 trials more take {more:.1f} MiB more")
    assert more < 25


def test_a_notebook_runs_a_sweep_without_a_terminal(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = []

    class Listener(SweepObserver):
        def ended(self, trial: Trial, record: TrialRecord) -> None:
            names.append(trial.name)

    words = ["+sweep=smoke", *QUICK, "engine=sequential", "tracking.pictures=false", store(folder)]
    trials = simbias.run_sweep(words, observer=Listener())
    assert list(trials["outcome"]) == ["succeeded"] * 4
    assert names == [trial.name for trial in expand(words).trials]
    assert capsys.readouterr().out == ""
    assert list(simbias.run_sweep(words)["hash"]) == list(trials["hash"])
    with pytest.raises(ConfigError, match=r"^sweep: missing"):
        simbias.run_sweep(["bias=none"])


IN_NUMPY = """
from point_mass import WithoutWind

class Walled(WithoutWind):
    def step(self, x, u):
        if (x[..., 0] > 1e6).any():
            raise ValueError("through the wall")
        return super().step(x, u)
"""


def test_own_components_are_swept(folder: Path) -> None:
    conf = folder / "conf"
    shutil.copytree(OWN_CONF, conf)
    (conf / "components.yaml").write_text("allow: [point_mass]\n")
    (conf / "nominal" / "walled.yaml").write_text("_target_: walled.Walled\n")
    (folder / "walled.py").write_text(IN_NUMPY)
    write_sweep(folder, "wind", "sweep: {trials: 2, axes: {hardware.wind: [1.0, 2.0]}}")
    own = [*(option for option in POINT_MASS if not option.startswith("nominal=")), "nominal=walled"]
    quick = ["optimizer.max_evaluations=40", "tracking.pictures=false"]
    status, _, err = run("--config-dir", "conf", "+sweep=wind", *own, *quick, folder=folder)
    assert status == 0, err
    (slow,) = (line for line in err.splitlines() if line != COMPILING)  # once, although every trial is
    assert slow.startswith("simbias: simulated in NumPy, up to 500 times slower")
    assert "Walled.step (walled.py:6: " in slow
    assert len(trial_by_trial(folder)) == 4


def trials_frame(sweep: Sweep, outcome: str = "succeeded") -> pd.DataFrame:
    rows = [
        {
            **dict(zip((axis.name for axis in sweep.axes), trial.cell.labels, strict=True)),
            "hash": trial.hash, "repetition": trial.repetition, "seed": trial.seed, "outcome": outcome,
            "experiments": 2.0 * (1 + index % 3), "iterations": 1.0 + index % 3, "seconds": 1.0,
            "raised": "", "run_id": "",
        }
        for index, trial in enumerate(sweep.trials)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_a_failure_counts_all_experiments_and_an_error_none() -> None:
    sweep = expand(["+sweep=smoke", "sweep.trials=3"])
    frame = trials_frame(sweep)
    frame.loc[0, ["outcome", "experiments"]] = ["not succeeded", 20.0]
    frame.loc[1, ["outcome", "experiments"]] = ["error", np.nan]
    first, second = cells(frame, sweep).to_dict("records")
    own = [20.0, 2.0 * 3, 2.0 * 2]
    assert (first["trials"], first["succeeded"], first["raised"]) == (3, 2, 0)
    assert first["mean"] == pytest.approx(np.mean(own))
    assert first["low"] <= first["mean"] <= first["high"]
    assert (second["trials"], second["succeeded"], second["raised"]) == (2, 2, 1)
    text = markdown(layout(cells(frame, sweep), sweep))
    assert "| 2/3 |" in text
    assert "| 2/2, 1 raised |" in text


def test_measures_are_those_that_the_report_names() -> None:
    sweep = expand(["+sweep=smoke", "sweep.trials=3", "+sweep.report.measures=[iterations,succeeded]"])
    laid = layout(cells(trials_frame(sweep), sweep), sweep)
    assert [head.rpartition(": ")[2] for head in laid.head[-2:]] == ["iterations", "succeeded"]
    assert [line[-2:] for line in laid.body] == [["2.0", "3/3"]] * 2
    assert "iterations: likewise" in legend(sweep, results.frame([], sweep))


def test_a_number_at_the_head_of_columns_says_of_what() -> None:
    def head(columns: str) -> list[str]:
        sweep = expand(["+sweep=learners", "sweep.trials=1", f"sweep.report.columns={columns}"])
        return layout(cells(trials_frame(sweep), sweep), sweep).head

    assert {"inertia error 0: experiments", "inertia error 0.2: experiments"} <= set(
        head("hardware.inertia_error")
    )
    assert {"gp: experiments", "sparse_gp: experiments"} <= set(head("bias"))


def test_interval_covers_the_mean_in_most_samples() -> None:
    """And does not depend on the order of the values."""
    rng = np.random.default_rng(0)
    samples = [rng.exponential(5.0, 30) for _ in range(200)]
    covered = np.mean([low <= 5.0 <= high for low, high in map(interval, samples)])
    assert 0.87 <= covered <= 0.98
    assert interval([1.0, 2.0, 5.0]) == interval([5.0, 1.0, 2.0])
    assert np.isnan(interval([3.0])).all()
    assert interval([4.0, 4.0]) == (4.0, 4.0)


def test_the_interval_of_a_large_cell_takes_no_more_memory() -> None:
    """All its draws at once would take 160 MB."""
    tracemalloc.start()
    try:
        interval(np.arange(2000.0))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 40e6


def test_live_view_fills() -> None:
    sweep = expand(["+sweep=smoke", "tracking=none", *QUICK])
    out = io.StringIO()
    terminal = Console(file=out, force_terminal=True, width=100)
    console = SweepConsole(terminal)
    console.begun(sweep, trials_frame(sweep).iloc[:0], keeps=False)
    for trial in sweep.trials:
        console.ended(trial, run_plan(plan(trial)))
    console.all_ended()
    assert "4/4" in out.getvalue()
    assert "2/2   2.0" in out.getvalue()
    assert "/min" in out.getvalue()


def test_a_workers_record_is_small_and_plain() -> None:
    trial = expand(["+sweep=smoke", "tracking=none", *QUICK]).trials[0]
    record = run_plan(plan(trial))
    assert record.outcome.final
    assert all(iteration.search.fitted_bias is None for iteration in record.iterations if iteration.search)
    direct = list(build(trial.composition).run())
    assert [i.hardware_cost for i in record.iterations] == [i.hardware_cost for i in direct]
