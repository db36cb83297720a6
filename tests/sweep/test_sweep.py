"""What a sweep runs, keeps and tells."""

import io
import json
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
from conftest import OWN_CONF, POINT_MASS
from errors import one_line
from mlflow import MlflowClient
from mlflow.cli import gc
from rich.console import Console
from sweeping import (
    FOLDERS,
    NO_FIGURES,
    QUICK,
    client_of,
    content,
    run,
    runs,
    state,
    sweep_folder,
    table,
    trial_by_trial,
    write_sweep,
)
from texts import write

import simbias
from simbias.__main__ import main
from simbias.config import ConfigError
from simbias.engine.contract import EngineLostError
from simbias.engine.sequential import Sequential
from simbias.mlflow.pages import DROPPED, PARENT
from simbias.mlflow.runs import superseded
from simbias.sweep import results, tables
from simbias.sweep.figure import UndrawnError
from simbias.sweep.folder import CHANGED, SweepFolder
from simbias.sweep.grid import Trial, expand
from simbias.sweep.running import SweepObserver
from simbias.sweep.worker import PlannedTrial, Result, run_plan
from simbias.terminal.notices import COMPILING
from simbias.terminal.sweep import SweepConsole

pytestmark = pytest.mark.slow

SMOKE = ["+sweep=smoke", *QUICK, *FOLDERS, "engine=sequential"]


@pytest.fixture
def unpainted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures without their pictures, which take half a second: `test_sweeps.py` looks at these."""
    monkeypatch.setattr("simbias.pictures.elements.style.save", lambda _, path: path.touch())


def test_the_folder_tells_everything(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noise = "sweep.axes.noise.values=[[0.0,0.0,0.0],[0.1,0.0,0.0]]"
    command = ["+sweep=table2", "sweep.trials=1", *QUICK, noise, "engine=sequential", *FOLDERS]
    assert main(command) == 0
    out, own, told = capsys.readouterr().out, sweep_folder(folder), state(folder)
    assert f"Look at it:  {own.relative_to(folder)}\n" in out
    assert "     0.1         0         0" in out
    assert "| torque variance | angle variance | velocity variance | no error: experiments |" in told["table"]
    assert "| 0.1 | 0 | 0 | 2.0 | 1/1 [21%, 100%] | 5.5 | 2.0 | 1/1 [21%, 100%] | 2.5 |" in told["table"]
    assert (told["verdict"], told["done"], told["outcomes"]) == ("**Done**", 4, {"succeeded": 4})
    assert (own / "table.md").read_text() == told["table"]
    assert list(pd.read_csv(own / "table.csv")["paper"]) == [6.4, 2.8, 5.5, 2.5]
    trials = pd.read_csv(own / "trials.csv")
    assert set(trials["hash"]) == trial_by_trial(folder).keys()
    assert told["mean_experiments"] == trials["experiments"].mean()
    assert told["captions"]["table2"].startswith("Mean number of hardware experiments")
    assert (own / "figures" / "table2.png").stat().st_size > 5000
    described = json.loads((own / "sweep.json").read_text())
    assert described["trials"].keys() == set(trials["hash"])
    before = {file: file.read_bytes() for file in folder.rglob("*.*") if file.is_file()}
    assert main(command) == 0  # nothing is missing
    assert "= 4, 4 of them finished already" in capsys.readouterr().out
    assert {file: file.read_bytes() for file in folder.rglob("*.*") if file.is_file()} == before


def test_a_notebook_adds_trials_without_a_terminal(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Cells and trials that are added run alone."""
    names: list[str] = []

    class Listener(SweepObserver):
        def ended(self, trial: Trial, result: Result) -> None:
            names.append(trial.name)

    one_cell = "sweep.axes={hardware.inertia_error: [0.2]}"
    few = simbias.run_sweep([*SMOKE, NO_FIGURES, one_cell, "sweep.trials=1"])
    more = simbias.run_sweep([*SMOKE, NO_FIGURES], observer=Listener())
    assert list(more["outcome"]) == ["succeeded"] * 4
    assert names == [trial.name for trial in expand(SMOKE).trials if trial.hash not in set(few["hash"])]
    again = more[more["hash"].isin(few["hash"])].reset_index(drop=True)
    pd.testing.assert_frame_equal(again, few)
    assert capsys.readouterr().out == ""
    swept = simbias.load_trial(f"trials/{more['hash'][3]}")
    assert swept.summary.experiments == more["experiments"][3]
    single = [*QUICK, *FOLDERS, "hardware.inertia_error=0.2", f"seed={swept.study.seed}"]
    for where, words in (("elsewhere", "Succeeded"), ("trials", "in an earlier run of this command")):
        assert main([*single, f"tracking.trials={where}"]) == 0  # as a trial of its own
        assert words in capsys.readouterr().out
        assert content(folder / where / swept.study.hash) == content(folder / "trials" / swept.study.hash)
    with pytest.raises(ConfigError, match=r"^sweep: missing"):
        simbias.run_sweep(["bias=none"])


@pytest.mark.usefixtures("unpainted")
def test_a_part_of_a_sweep_leaves_its_record_and_others_say_what_it_loses(
    folder: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both run and are told."""
    quick = [*SMOKE, "sweep.trials=1", "tracking.pictures=false"]
    assert main(quick) == 0
    own = sweep_folder(folder)
    before = {file: file.read_bytes() for file in own.rglob("*.*") if file.is_file()}
    for values, cells, said in (
        ("[0.2]", 1, f"running 1 of the 2 trials of {own.relative_to(folder)}: "),
        ("[0.2, 0.3]", 2, f"{own.relative_to(folder)} drops 1 of its 2 trials, "),
    ):
        assert before == {file: file.read_bytes() for file in own.rglob("*.*") if file.is_file()}
        capsys.readouterr()
        assert main([*quick, f"sweep.axes={{hardware.inertia_error: {values}}}"]) == 0
        assert f"{cells} cells x 1 trials = {cells}, 1 of them" in capsys.readouterr().out
        (record,) = caplog.records
        assert record.getMessage().startswith(f"simbias: {said}")
        caplog.clear()
    record = (own / "sweep.json").read_text()
    (own / "sweep.json").write_text(record[:50])
    with one_line(r"sweep\.json: cannot be read .*\. Delete it: the command of the whole sweep recreates it"):
        simbias.run_sweep([*quick, "sweep.axes={hardware.inertia_error: [0.2]}"])
    (own / "sweep.json").write_text(record)
    assert len(SweepFolder(own).trials_recorded()) == 2
    assert len(pd.read_csv(own / "trials.csv")) == 2
    for name in SweepFolder(own).trials_recorded():  # as if none had been made before it was killed
        shutil.rmtree(folder / "trials" / name)
    assert main([*quick, "sweep.axes={hardware.inertia_error: [0.2]}"]) == 0
    assert len(SweepFolder(own).trials_recorded()) == 1


def test_the_command_that_resumes_names_folders_and_modules_of_ones_own(folder: Path) -> None:
    conf = write_sweep(folder, "mine", "sweep: {trials: 1, axes: {}, figures: {}}")
    command = [["+sweep=mine", *QUICK, *FOLDERS, "engine=sequential"], "conf", None, ["json"]]
    simbias.run_sweep(*command)
    told = json.loads((sweep_folder(folder) / "sweep.json").read_text())["command"]
    assert told == f"simbias.run_sweep({command[0]!r}, config_dir='{conf.name}', allow=['json'])"


def test_what_is_odd_is_counted_in_all_trials_of_the_table(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whichever of them ran in an earlier process."""
    refuted = [*SMOKE, NO_FIGURES, "bias=none", "cost.max_cost=1e-3"]  # never reached
    for trials in (1, 2, 2):
        assert main([*refuted, f"sweep.trials={trials}"]) == 0
        said = f"\nIn {2 * trials} of {2 * trials} trials: a refuted policy was tried again.\n"
        assert said in capsys.readouterr().out


def test_dry_run_runs_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def told() -> tuple[list[str], str]:
        """How far each cell is, and what is said of the sweep."""
        capsys.readouterr()
        assert main([*SMOKE, "sweep.dry_run=true", "engine=loky"]) == 0
        *table, said = capsys.readouterr().out.splitlines()
        return [line.split()[-1] for line in table[2:]], said

    cells, said = told()
    assert cells == ["0/2", "0/2"]
    assert said == "smoke: 0 of 4 trials are finished; the remaining time cannot be estimated yet."
    assert simbias.run_sweep([*SMOKE, "sweep.dry_run=true"]).empty
    assert not list(folder.iterdir())
    assert main([*SMOKE, "sweep.trials=1", NO_FIGURES]) == 0
    cells, said = told()
    assert cells == ["1/2", "1/2"]
    assert said.startswith("smoke: 2 of 4 trials are finished; judging by these, the others may take ")
    assert said.endswith(" on 2 jobs.")
    assert len(list(folder.glob("trials/*/trial.json"))) == 2


def test_a_folder_that_somebody_damaged_is_named(
    folder: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its trial is resumed where its trial.json is whole, and moved away, made again."""
    trials = simbias.run_sweep([*SMOKE, NO_FIGURES])
    before = trial_by_trial(folder)
    cut, gone, *others = (folder / "trials" / identity for identity in trials["hash"])
    damaged = [cut / "outcome.json", *(other / "trial.json" for other in others)]
    for file, text in zip(damaged, ("{", "{", ""), strict=True):
        file.write_text(text)
    damaged[-1].unlink()
    shutil.rmtree(gone)
    assert simbias.run_sweep([*SMOKE, "sweep.dry_run=true"]).empty
    capsys.readouterr()
    assert main([*SMOKE, NO_FIGURES]) == 1
    places = [file.relative_to(folder) for file in damaged]
    starts = [
        *(f"{place}: cannot be read" for place in places[:-1]),
        f"{places[-1].parent}: is not the folder",
    ]
    for start, record in zip(starts, caplog.records, strict=True):
        line = record.getMessage()
        assert line.startswith(f"simbias: {start}")
        assert line.count("cannot be read") <= 1
        assert line.endswith("; the trial counts as unfinished")
    told = capsys.readouterr()
    for file, words in zip(damaged[1:], ("cannot be read", "is missing. Put it back"), strict=True):
        assert f"{file.parent.name}/trial.json: {words}" in told.out + told.err
        shutil.rmtree(file.parent)
    again = simbias.run_sweep([*SMOKE, NO_FIGURES])
    assert trial_by_trial(folder) == before
    pd.testing.assert_frame_equal(again.drop(columns="seconds"), trials.drop(columns="seconds"))


@pytest.mark.usefixtures("unpainted")
def test_a_sweep_of_tested_policies_needs_no_tests_any_more_and_others_are_told(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figure = "tests: {_target_: simbias.sweep.figures.last_policies.LastPolicies}"
    write_sweep(folder, "mine", f"sweep: {{trials: 1, axes: {{bias: [none]}}, figures: {{{figure}}}}}")
    command = ["--config-dir", "conf", "+sweep=mine", *QUICK, *FOLDERS, "engine=sequential"]
    assert main([*command, "policy_test={episodes: 1, long_episodes: 0}"]) == 0
    assert main(command) == 0
    assert capsys.readouterr().err == ""
    assert main([*command, "policy_test={episodes: 2, long_episodes: 0}"]) == 0
    said = (
        "1 of 1 finished trials were not tested as policy_test now asks; tracking.trials=FOLDER starts afresh"
    )
    assert capsys.readouterr().err == f"simbias: {said}\n"


@pytest.mark.parametrize(("moved", "said"), [("trials", "trials"), ("trials/sweeps", r"trials/sweeps/\S+")])
def test_a_folder_that_is_moved_while_its_sweep_runs_stops_it(folder: Path, moved: str, said: str) -> None:
    class Mover(SweepObserver):
        def ended(self, trial: Trial, result: Result) -> None:
            (folder / moved).rename(folder / "elsewhere")

    with pytest.raises(ConfigError, match=rf"^tracking: the folder {said} is gone: was it moved"):
        simbias.run_sweep([*SMOKE, NO_FIGURES], observer=Mover())
    assert not (folder / moved).exists()


@pytest.mark.usefixtures("unpainted")
def test_figures_stay_while_a_sweep_grows_and_once_it_is_interrupted(folder: Path) -> None:
    class Interrupting(SweepObserver):
        def ended(self, trial: Trial, result: Result) -> None:
            assert len(SweepFolder(sweep_folder(folder)).figures()) == 5
            raise KeyboardInterrupt

    one_cell = [*SMOKE, "sweep.axes={hardware.inertia_error: [0.2]}"]
    simbias.run_sweep([*one_cell, "sweep.trials=1"])
    with pytest.raises(KeyboardInterrupt):
        simbias.run_sweep([*one_cell, "sweep.trials=2"], observer=Interrupting())
    assert len(SweepFolder(sweep_folder(folder)).figures()) == 5


@pytest.mark.usefixtures("unpainted")
def test_a_figure_that_raises_is_named_and_costs_neither_table_nor_other_figures(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = "costs: {_target_: simbias.sweep.figures.costs.Costs}, "
    figures += "experiments: {_target_: simbias.sweep.figures.experiments.Experiments}"
    write_sweep(folder, "mine", f"sweep: {{trials: 1, axes: {{bias: [none]}}, figures: {{{figures}}}}}")
    command = ["+sweep=mine", *QUICK, *FOLDERS, "engine=sequential"]
    monkeypatch.setattr("simbias.sweep.figures.costs.Costs.draw", Mock(side_effect=KeyError("x")))
    assert main(["--config-dir", "conf", *command]) == 1
    out, err = capsys.readouterr()
    assert "experiments" in out
    line = r"simbias: figure costs: KeyError: 'x' \(traceback in (.*)\)\nResume with:  .*\n"
    assert (trace := re.fullmatch(line, err))
    assert "KeyError" in Path(trace[1]).read_text()
    assert {file.stem for file in SweepFolder(sweep_folder(folder)).figures()} == {"experiments"}
    with pytest.raises(UndrawnError, match=r"^costs: KeyError: 'x'$") as raised:
        simbias.run_sweep(command, "conf")
    assert len(raised.value.trials) == 1


def test_a_sweep_that_is_interrupted_at_its_start(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before its trials are read it counts none; what MLflow has imported by then is not imported again."""
    begun = {"running.SweepState": "", "tracking.Tracking.export_sweep": "; 0 of 4 trials are done"}
    for interrupted, counts in begun.items():
        with monkeypatch.context() as patch:
            patch.setattr(f"simbias.sweep.{interrupted}", begin := Mock(side_effect=KeyboardInterrupt))
            assert main([*SMOKE, NO_FIGURES]) == 130
        assert capsys.readouterr().err.startswith(f"simbias: interrupted{counts}.\nResume with:  ")
        assert begin.call_count == 1


def test_an_engine_that_is_lost_is_one_line_and_the_command_that_resumes(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(_: object, function: Callable[[Any], Any], tasks: Sequence[Any], code: object) -> Iterator[Any]:
        yield 0, function(tasks[0])
        raise EngineLostError("", "the scheduler is gone")

    with monkeypatch.context() as patch:
        patch.setattr(Sequential, "run", lost)
        assert main([*SMOKE, NO_FIGURES]) == 1
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "simbias: the scheduler is gone; 1 of 4 trials are done."
    assert said[1].startswith("Resume with:  ")


def test_trials_that_all_raise_are_told_in_a_table(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No figure can be drawn; a sweep that stopped amid its trials says how many are unfinished."""
    raising = ["+sweep={trials: 2, axes: {bias: [none, gp]}}", "hardware=process"]
    command = [*raising, "hardware.command=/bin/false", *QUICK, *FOLDERS, "engine=sequential"]
    assert main(command) == 1
    out = capsys.readouterr()
    assert f"{tables.BLANK}, 2 raised" in out.out
    assert "4 trials raised an error; the same command resumes" in out.out + out.err
    assert state(folder)["verdict"] == "**Ended**, some trials with an error"
    sweep = expand(command)
    none = tables.cells(results.of_folders(sweep, folder / "nowhere", print), sweep)
    assert [row[-1] for row in tables.layout(none, sweep).body] == [f"{tables.BLANK}, 2 unfinished"] * 2


def test_bad_input_runs_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for key, overrides in {
        "bias.d: must be greater than or equal to 0": [
            "+sweep=smoke",
            "+sweep.axes.x={keys: bias.d, values: [1, -1]}",
        ],
        "engine.n_jobs: must be greater than 0": ["+sweep=smoke", "engine.n_jobs=0"],
        "method: searches on the hardware itself, but Manual is not a simulator (in the cell ideal)": [
            "+sweep={trials: 1, axes: {method: [ideal]}}", "hardware=manual"
        ],
        "policy_test.episodes: is 0, but sweep.figures.gaps": ["+sweep=gaps", "policy_test.episodes=0"],
        "policy_test.episodes: is 0, but sweep.report.measures has holds": [
            "+sweep=smoke", "+sweep.report={measures: [holds]}"
        ],
        "hardware.confirm: must be false: a sweep cannot ask": ["+sweep=smoke", "hardware.confirm=true"],
        "tracking: none keeps no trials": ["+sweep=fig4", "tracking=none"],
        "sweep.figures.fig4.columns: ": ["+sweep=fig4", "sweep.figures.fig4.columns=0"],
        "sweep.figures.fig4.colour: ": ["+sweep=fig4", "+sweep.figures.fig4.colour=red"],
        "sweep.figures.fig5: ": ["+sweep=fig5", "sweep.figures.fig5.states=[alpha_w,alpha_b,x]"],
        "sweep.figures.fig7: ": ["+sweep=fig7", "sweep.figures.fig7.hardware=real"],
        "sweep.figures.fig6._target_": [
            "+sweep=fig6", "sweep.figures.fig6._target_=simbias.trial.study.Study"
        ],
        "sweep.figures.a/b": ["+sweep=smoke", "+sweep.figures={a/b: {_target_: x.Y}}"],
    }.items():  # fmt: skip
        assert main(overrides) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"simbias: {key}")
    assert main(["+sweep={trials: 1, axes: {task.horizon: [5]}}"]) == 2
    assert re.search("^simbias: task.horizon: .* too short .* \\(in the cell 5\\)$", capsys.readouterr().err)
    assert not list(folder.iterdir())


IN_NUMPY = """
from point_mass import InTheWind, WithoutWind

class Walled(WithoutWind):
    def step(self, x, u):
        if (x[..., 0] > 1e6).any():
            raise ValueError("through the wall")
        return super().step(x, u)

class Stoppable(InTheWind):
    def stop(self):
        pass
"""


def test_own_components_are_swept(folder: Path) -> None:
    conf = folder / "conf"
    shutil.copytree(OWN_CONF, conf)
    components = {"nominal/walled": "walled.Walled", "hardware/robot": "walled.Stoppable\nwind: 2.0"}
    write(conf, {f"{name}.yaml": f"_target_: {target}\n" for name, target in components.items()})
    write(conf, {"components.yaml": "allow: [point_mass]\n"})
    write(folder, {"walled.py": IN_NUMPY})
    axes = "{hardware.wind: [1.0, 2.0], nominal: [walled, point_mass]}"
    write_sweep(folder, "wind", f"sweep: {{trials: 1, figures: {{}}, axes: {axes}, common_seeds: [nominal]}}")
    own = [option for option in POINT_MASS if not option.startswith("nominal=")]
    quick = ["bias=none", "optimizer.max_evaluations=10", "method.max_iterations=1", *FOLDERS]
    command = ["--config-dir", "conf", "+sweep=wind", *own, *quick, "engine=sequential"]
    status, _, err = run(*command, folder=folder)
    assert status in (0, 1), err
    (slow,) = (line for line in err.splitlines() if line != COMPILING)  # once, although every trial is
    assert slow.startswith("simbias: simulated in NumPy, up to 500 times slower")
    assert "Walled.step (walled.py:6: " in slow
    assert len(trial_by_trial(folder)) == 4
    assert len(table(folder).splitlines()) == 5
    assert run(*command, folder=folder)[2] == ""  # no code has changed since
    robot = [*command, "hardware=robot"]
    assert run(*robot, "sweep.dry_run=true", "engine=loky", folder=folder)[::2] == (0, "")
    status, _, err = run(*robot, "engine=loky", folder=folder)
    assert status == 2
    assert err.startswith("simbias: engine: several trials would use Stoppable at the same time, ")


def test_live_view_fills() -> None:
    sweep = expand(["+sweep=smoke", "tracking=none", *QUICK])
    out = io.StringIO()
    console = SweepConsole(Console(file=out, force_terminal=True, width=100))
    console.begun(sweep, pd.DataFrame(columns=["outcome"]), None)
    for trial in sweep.trials:
        console.ended(trial, run_plan(PlannedTrial(trial.composition)))
    console.all_ended()
    for words in ("4/4", "2/2   2.0", "/min"):
        assert words in out.getvalue()


@pytest.fixture
def store(folder: Path, new_store: Path) -> str:
    """The override that names a store in the working folder."""
    shutil.copy(new_store, folder)
    return f"tracking.uri=sqlite:///{folder}/mlflow.db"


def histories(folder: Path) -> dict[tuple[str, str], list[Any]]:
    """Values of all metrics of all runs."""
    client = client_of(folder)
    found = [run for some in runs(folder) for run in some]
    return {
        (run.info.run_id, name): [(m.step, m.value) for m in client.get_metric_history(run.info.run_id, name)]
        for run in found
        for name in run.data.metrics
    }


def test_a_trial_that_waits_has_one_run(folder: Path, store: str) -> None:
    """Figures wait, too: of trials that have not ended there may be none."""
    figures = "{costs: {_target_: simbias.sweep.figures.costs.Costs}}"
    write_sweep(folder, "mine", f"sweep: {{trials: 1, axes: {{bias: [none, gp]}}, figures: {figures}}}")
    command = ["--config-dir", "conf", "+sweep=mine", *QUICK, "hardware=manual", "engine=sequential", store]
    for _ in range(2):
        assert main(command) == 3
        parents, trials = runs(folder)
        assert [run.info.status for run in (*parents, *trials)] == ["SCHEDULED"] * 3
    assert state(folder)["verdict"].startswith("**Waiting**")


@pytest.mark.usefixtures("unpainted")
def test_a_sweep_that_was_relabelled_is_shown_as_it_is_now_and_a_part_of_it_whole(
    folder: Path, store: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A figure that is not of it any more keeps its file; started again, it adds nothing to its store."""
    figures = "experiments: {_target_: simbias.sweep.figures.experiments.Experiments}"
    axis = "error: {keys: hardware.inertia_error, values: [0.0, 0.2], labels: [none, some]}"
    whole = f"sweep: {{trials: 1, axes: {{{axis}}}, figures: {{{figures}}}}}"
    part = whole.replace("[0.0, 0.2]", "[0.20]").replace("[none, some]", "[more]").replace(figures, "")
    other = whole.replace("some", "more").replace(figures, "")
    command = ["--config-dir", "conf", "+sweep=mine", *QUICK, "engine=sequential", store]
    command.append("tracking.pictures=false")
    for text, label in ((whole, "some"), (part, "some"), (other, "more")):
        write_sweep(folder, "mine", text)
        assert main(command) == 0
        (parent,), trials = runs(folder)
        assert (parent.info.status, parent.data.metrics["trials/succeeded"]) == ("FINISHED", 2)
        assert "2 of 2 [trials]" in parent.data.tags["mlflow.note.content"]
        assert {(run.info.run_name, run.data.tags["axis.error"]) for run in trials} == {
            ("none #0", "none"), (f"{label} #0", label),
        }  # fmt: skip
        assert ("experiments.png" in parent.data.tags["mlflow.note.content"]) == (label == "some")
        if text == whole:
            before = histories(folder)
            assert all(len(values) == len(dict(values)) for values in before.values())
            with monkeypatch.context() as patch:
                patch.setattr(MlflowClient, "log_artifacts", upload := Mock())
                assert main(command) == 0
            assert upload.mock_calls == []
            assert histories(folder) == before
            assert runs(folder)[0][0].info.end_time == parent.info.end_time
    assert list((sweep_folder(folder) / "figures").iterdir())
    assert SweepFolder(sweep_folder(folder)).figures() == []
    before = histories(folder)
    write_sweep(folder, "mine", other.replace("more", "most"))
    assert main(command) == 0
    assert histories(folder) == before
    config = Path(client_of(folder).download_artifacts(parent.info.run_id, "sweep.yaml"))
    assert "most" in config.read_text()
    write_sweep(folder, "mine", whole)
    assert main(command) == 0
    assert {run.info.run_id for run in runs(folder)[1]} == {run.info.run_id for run in trials}
    meanless = {**state(folder), "mean_experiments": None, "digest": ""}  # as of trials with errors alone
    assert CHANGED not in runs(folder)[0][0].data.tags["mlflow.note.content"]
    SweepFolder(sweep_folder(folder)).write_state(meanless)
    for _ in range(2):
        assert main(["export", store]) == 0
    assert CHANGED in runs(folder)[0][0].data.tags["mlflow.note.content"]
    steps, means = zip(*histories(folder)[parent.info.run_id, "experiments/mean"], strict=True)
    assert np.isnan(means).tolist() == [False] * (len(steps) - 1) + [True]
    capsys.readouterr()
    damaged, gone = (folder / "trials" / run.data.tags["hash"] for run in trials)
    shutil.rmtree(gone)
    for place, lines in ((sweep_folder(folder), 1), (damaged, 2)):
        assert main(["export", str(place), store]) == 0
        out = capsys.readouterr().out.splitlines()[-lines:]
        assert out == ["sweep mine: 1 of 2 trials", "0 trials in no sweep"][:lines]
    assert main(["export", store]) == 0
    (damaged / "outcome.json").write_text("{")
    assert main(["export", store]) == 1
    assert capsys.readouterr().out == "".join(
        f"sweep mine: {count} of 2 trials\n0 trials in no sweep\n" for count in (1, 0)
    )


@pytest.mark.usefixtures("unpainted")
def test_trials_that_a_sweep_drops_leave_it_and_return_as_they_were(folder: Path, store: str) -> None:
    command = ["+sweep=smoke", *QUICK, NO_FIGURES, "engine=sequential", store]
    one_cell = ["sweep.trials=3", "+sweep.axes={hardware.inertia_error: [0.0]}"]
    found = list[set[str]]()
    for axes in (["sweep.trials=2"], one_cell, ["sweep.trials=2"]):
        assert main([*command, *axes]) == 0
        _, nested = runs(folder)
        found.append({run.info.run_id for run in nested})
    first, other, last = found
    assert first == last
    assert not any(DROPPED in run.data.tags for run in nested if run.info.run_id in first)
    assert (len(first), len(other), len(first & other)) == (4, 3, 2)


@pytest.mark.usefixtures("unpainted")
def test_each_folder_of_a_sweep_has_a_run_in_which_each_trial_counts_once(folder: Path, store: str) -> None:
    """Also if the run was deleted, even from the store, or a trial was made again."""
    command = ["+sweep=smoke", *QUICK, NO_FIGURES, "sweep.trials=1", "engine=sequential", store]
    folders = ["tracking.trials=mine", "tracking.trials=yours"]

    def shown() -> dict[str, str]:
        """The parent of each trial's run."""
        parents, trials = runs(folder)
        found = {run.info.run_id: run.data.tags[PARENT] for run in trials if not superseded(run)}
        assert Counter(found.values()) == {run.info.run_id: 2 for run in parents}
        assert len(parents) == 2
        return found

    for each in folders:
        assert main([*command, each]) == 0
    uri = store.removeprefix("tracking.uri=")
    for cleaned in (False, True):
        before = shown()
        for each in runs(folder)[0]:
            client_of(folder).delete_run(each.info.run_id)
        if cleaned:
            gc.main(["--backend-store-uri", uri, "--tracking-uri", uri], standalone_mode=False)
        for each in folders:
            assert main(["export", store, each]) == 0
        after = shown()
        assert before.keys() == after.keys()
        assert set(before.values()).isdisjoint(after.values())
    shutil.rmtree(next(folder.glob("mine/*/trial.json")).parent)
    assert main([*command, folders[0]]) == 0
    assert len(shown().keys() - before.keys()) == 1
