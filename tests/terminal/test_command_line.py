"""The command line as a person uses it."""

import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from conftest import OWN_CONF, POINT_MASS, PYTHONPATH, ROOT
from omegaconf import OmegaConf
from sweeping import FOLDERS, run, start

from simbias.__main__ import COMMANDS, main
from simbias.config import compose
from simbias.search.optimizer import ilqr
from simbias.terminal.arguments import EXAMPLES, parse

pytestmark = pytest.mark.slow

QUICK = ["task.horizon=200", "optimizer.max_evaluations=20"]  # 0.2 s are balanced without any torque


def test_success_exits_0_and_says_how_many_experiments(
    new_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In plain text, as into a notebook; a reader that has seen enough meets no traceback."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    shutil.copy(new_store, tmp_path)
    status, out, err = run(*QUICK, "tracking.pictures=false", folder=tmp_path)
    assert status == 0, err
    assert "Succeeded after 2 hardware experiments (1 iteration, " in out
    assert " -m simbias ui " in out
    assert "Traceback" not in err
    assert "\x1b" not in out + err
    assert not list(tmp_path.glob("trials/*/pictures"))
    process = start(*QUICK, "tracking=folders", "seed=1", folder=tmp_path)
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline().startswith("algorithm1 on bongoboard")
    process.stdout.close()
    assert "Error" not in process.stderr.read()
    assert process.wait() == 1


def test_a_trial_whose_output_is_closed_runs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    assert main([*QUICK, "tracking=folders", "tracking.pictures=false"]) == 0


def test_many_trials_are_no_multirun_of_hydras(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse(["-m", "seed=1,2"], "0")
    assert "unrecognized arguments: -m; a sweep runs many trials (+sweep=NAME)" in capsys.readouterr().err


def used() -> float:
    """Seconds of processor time of the processes that were started here and have ended."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime


@pytest.fixture
def line(folder: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """The command line in this process, in an empty folder: arguments -> (status, stdout, stderr)."""
    return lambda *arguments: (main(arguments), *capsys.readouterr())


def test_failure_exits_1_and_says_why(line: Any, tmp_path: Path) -> None:
    short = ["task.horizon=3000", "optimizer.max_evaluations=3", "method.max_iterations=1"]
    status, out, _ = line(*short, "tracking=none")
    assert status == 1
    assert "Did not succeed after 2 hardware experiments" in out
    assert "Of the last policy, 2 of 2 experiments failed: " in out
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("uncompiled")
def test_random_experiments_are_named(line: Any) -> None:
    """They are of no policy."""
    pendulum = [
        "preset=[pendulum_swingup,scratch]",
        "budget.experiments=1",
        "tracking=none",
    ]
    status, out, _ = line(*pendulum)
    assert status == 1
    assert re.search(r"^Random experiments: [\d.]+ \(6\.00 s\)\.$", out, re.MULTILINE)
    assert "unfinished" not in out


def test_bad_input_exits_2_with_one_line(line: Any, tmp_path: Path) -> None:
    """Also a name that no system takes, and columns that are nested too deeply."""
    for arguments, said in (
        (["optimizer=unknown"], "optimizer=unknown"),
        (["chekc"], "no such command: chekc; available: check, "),
        (["bias=none", "check"], "write the command first: python -m simbias check bias=none ..."),
        (["report", "trials", "--cfg", "job"], "--cfg: report has no config to show"),
        (["preview", "method=ideal", "hardware=manual"], "method: searches on the hardware itself"),
        (["report", "x" * 5000], "File name too long"),
        (["identify", "x" * 5000], "File name too long"),
        (["identify", "x.csv", "--columns", "[" * 3000], "--columns: "),
    ):
        status, out, err = line(*arguments)
        assert (status, out, len(err.splitlines())) == (2, "", 1), err
        assert err.startswith("simbias: ")
        assert said in err
    assert not list(tmp_path.iterdir())


def test_an_error_of_the_system_is_one_line_without_a_file_too(
    line: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    for error, said in ((OSError(28, "No space left"), "No space left"), (TimeoutError(), "TimeoutError")):
        monkeypatch.setitem(COMMANDS, "new", Mock(side_effect=error))  # type: ignore[arg-type]
        assert line("new", "x") == (2, "", f"simbias: {said}\n")


@pytest.mark.usefixtures("uncompiled")
def test_bad_input_that_a_planner_finds_exits_2_too(line: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a line without a type, a traceback and a command that would stop so again."""
    monkeypatch.setattr(ilqr, "ITERATIONS", 0)
    quick = ["preset=cartpole_trajectory", "task.horizon=20", "task.hold=0.1", "policy.knots=11"]
    status, _, err = line(*quick, "+task.states.d_position.mean=100", *FOLDERS)
    *_, said = err.splitlines()  # after those on the compilation
    start = "(angle 3.14159 rad, d_position 100 m/s)"
    assert status == 2
    assert said.startswith(f"simbias: method.trajectories: the model fails from its start {start}, ")
    assert said.endswith(" from -10 to 10 N (0 hardware experiments kept)")


@pytest.mark.usefixtures("uncompiled")
def test_own_components_run(line: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Options may stand anywhere, also before a command, and `run` is the command that is meant."""
    own = ["--config-dir", str(OWN_CONF)]
    assert line(*POINT_MASS, *own, "tracking=none", "optimizer.max_evaluations=40")[0] == 0
    status, out, _ = line(*own, "check", *POINT_MASS)
    assert status == 0
    assert "task point_mass: all checks hold" in out
    monkeypatch.setattr("point_mass.Distance.max_cost", 100.0)
    status, out, _ = line(*own, "check", *POINT_MASS)
    assert status == 1
    assert "task point_mass: 1 check failed" in out  # an early fall costs less
    shown = line(*POINT_MASS, "--cfg", "job", *own)
    for command in ("run", "check", "preview", "export"):
        assert line(command, *own, *POINT_MASS, "--cfg", "job") == shown
    status, out, _ = line("--cfg", "job", "bias.d=2")
    assert status == 0
    assert OmegaConf.create(out).bias.d == 2


@pytest.mark.usefixtures("uncompiled")
def test_a_trial_that_ended_and_was_damaged_is_no_success(line: Any, folder: Path) -> None:
    """An outcome alone is made again, and that is told."""
    own = ["--config-dir", str(OWN_CONF), *POINT_MASS, "optimizer.max_evaluations=40", *FOLDERS]
    assert line(*own)[0] == 0
    (outcome,) = folder.glob("trials/*/outcome.json")
    outcome.write_text("")
    status, out, err = line(*own)
    assert (status, "in an earlier run" in out) == (0, False)
    assert f"simbias: {outcome.relative_to(folder)}: cannot be read" in err
    assert "). Running its trial again recreates it from the steps\n" in err
    (outcome.parent / "0000_search.json").write_text("")
    status, out, err = line(*own)
    assert (status, "Succeeded" in out) == (2, False)
    assert "0000_search.json: cannot be read" in err


def test_options_may_stand_anywhere() -> None:
    places = ["one.csv", "preset=cartpole", "seed=1"]
    for at in range(4):
        parsed = parse(["identify", *places[:at], "--into", "x", *places[at:]], "0")
        assert (parsed.words, parsed.into) == (places, "x")
    for wrong in (["--recovers", "seed=1"], ["seed=1", "--port", "3"], ["--recover", "--attach"]):
        with pytest.raises(SystemExit):
            parse(["identify", *wrong], "0")


def test_help_of_a_command_is_of_it_alone(capsys: pytest.CaptureFixture[str]) -> None:
    for command, said in (
        ("withdraw", "own command then resumes the trial"),
        ("preview", "It writes preview.png."),
    ):
        with pytest.raises(SystemExit):
            parse([command, "--help"], "0")
        usage, _, rest = " ".join(capsys.readouterr().out.split()).partition(" [-h]")
        assert usage == f"usage: python -m simbias {command}"
        assert said in rest
    for command in COMMANDS:
        with pytest.raises(SystemExit):
            parse([command, "--help"], "0")
        assert ("--cfg" in capsys.readouterr().out) == (command in ("run", "check", "preview", "export"))


def test_help_is_quick_and_complete(tmp_path: Path) -> None:
    """What it advertises composes."""
    command, before = [sys.executable, "-m", "simbias", "--help"], used()
    environment = os.environ | {"PYTHONPATH": PYTHONPATH, "COLUMNS": "120"}
    out = subprocess.check_output(command, cwd=tmp_path, env=environment, text=True, timeout=120)
    assert used() - before < 1.5
    for folder in (path for path in (ROOT / "conf").iterdir() if path.is_dir()):
        (line,) = re.findall(rf"^  {folder.name} +(.+)$", out, re.MULTILINE)
        assert sorted(line.split(" | ")) == sorted(file.stem for file in folder.glob("*.yaml"))
    assert "hardware.inertia_error=0.2" in out
    examples = [each for each in EXAMPLES.splitlines() if each.startswith("  ") and "=" in each]
    named = [override for each in examples if not (override := re.split("  +", each)[1]).startswith("python")]
    assert len(named) >= 8
    for override in named:
        compose([override])
