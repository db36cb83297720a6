"""The command line as a person uses it."""

from __future__ import annotations

import os
import re
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from conftest import OWN_CONF, POINT_MASS, PYTHONPATH, ROOT
from omegaconf import OmegaConf

from simbias.__main__ import main
from simbias.config import compose
from simbias.terminal.arguments import EXAMPLES, parse

pytestmark = pytest.mark.slow

QUICK = ["task.horizon=200", "optimizer.max_evaluations=20"]  # 0.2 s are balanced without any torque


def from_nothing(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """What a process with nothing imported has done."""
    environment = os.environ | {"PYTHONPATH": PYTHONPATH, "COLUMNS": "120"}
    return subprocess.run(
        [sys.executable, "-m", "simbias", *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def used() -> float:
    """Seconds of processor time of the processes that were started here and have ended."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime


def test_success_exits_0_and_says_how_many_experiments(tmp_path: Path) -> None:
    done = from_nothing(*QUICK, "tracking.pictures=false", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Succeeded after 2 hardware experiments (1 iteration, " in done.stdout
    assert " -m simbias ui " in done.stdout
    assert (tmp_path / "mlflow.db").exists()
    assert "Traceback" not in done.stderr


@pytest.fixture
def line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """The command line in this process, in an empty folder: arguments -> (status, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: (main(arguments), *capsys.readouterr())


def test_failure_exits_1_and_says_why(line: Any, tmp_path: Path) -> None:
    short = ["task.horizon=3000", "optimizer.max_evaluations=3", "method.max_iterations=1"]
    status, out, _ = line(*short, "tracking=none")
    assert status == 1
    assert "Did not succeed after 2 hardware experiments" in out
    assert "last failure: " in out
    assert not list(tmp_path.iterdir())


def test_bad_input_exits_2_with_one_line(line: Any, tmp_path: Path) -> None:
    for override in ("bias.d=abc", "optimizer=unknown", "nosuch=1", "chekc"):
        status, out, err = line(override)
        assert (status, out, len(err.splitlines())) == (2, "", 1)
    assert not list(tmp_path.iterdir())


def test_issue_example_swaps_components(line: Any) -> None:
    status, out, _ = line(
        *QUICK, "bias=none", "hardware.noise.torque_variance=0.1", "hardware.inertia_error=0.2",
        "optimizer=nlopt_crs", "seed=3", "tracking=none",
    )  # fmt: skip
    assert status == 0
    assert "bias none, optimizer nlopt_crs" in out
    assert "seed 3" in out


def test_own_components_run(line: Any) -> None:
    """Options may stand anywhere, also before a command, and `run` is the command that is meant."""
    own = ["--config-dir", str(OWN_CONF)]
    assert line(*POINT_MASS, *own, "tracking=none")[0] == 0
    checked = line(*own, "check", *POINT_MASS)
    assert checked == line("check", *POINT_MASS, *own)
    assert "task point_mass: 1 check failed" in checked[1]  # EveryFifth counts few samples
    assert line("run", *own, *POINT_MASS, "--cfg", "job") == line(*POINT_MASS, "--cfg", "job", *own)


def test_a_file_name_that_no_system_takes_is_one_line(line: Any) -> None:
    for command in (["identify"], ["report"]):
        status, out, err = line(*command, "x" * 5000)
        assert (status, out, err.count("\n")) == (2, "", 1), err
        assert err.startswith("simbias: ")
        assert err.endswith(": File name too long\n")


def test_columns_that_are_nested_too_deeply_are_one_line(line: Any) -> None:
    for nested in ("[" * 3000, "{a: " * 3000):
        status, out, err = line("identify", "x.csv", "--columns", nested)
        assert (status, out, err.count("\n")) == (2, "", 1), err
        assert err.startswith("simbias: --columns: ")


def test_options_may_stand_anywhere() -> None:
    places = ["one.csv", "preset=cartpole", "seed=1"]
    for words in (
        ["--into", "x", *places],
        [*places[:1], "--into", "x", *places[1:]],
        [*places, "--into", "x"],
    ):
        parsed = parse(["identify", *words], "0")
        assert (parsed.words, parsed.into) == (places, "x")
    for wrong in (["--recovers", "seed=1"], ["seed=1", "--port", "3"]):
        with pytest.raises(SystemExit):
            parse(["identify", *wrong], "0")


def test_help_is_quick_and_complete(tmp_path: Path) -> None:
    start = used()
    done = from_nothing("--help", folder=tmp_path)
    assert used() - start < 1.5
    assert done.returncode == 0
    for folder in (path for path in (ROOT / "conf").iterdir() if path.is_dir()):
        (line,) = re.findall(rf"^  {folder.name} +(.+)$", done.stdout, re.MULTILINE)
        assert sorted(line.split(" | ")) == sorted(file.stem for file in folder.glob("*.yaml"))
    for word in ("  optimizer      nlopt_direct | ", "  bias           gp | ", "hardware.inertia_error=0.2"):
        assert word in done.stdout


def test_values_that_help_names_exist() -> None:
    """What --help advertises composes."""
    overrides = [
        re.split("  +", line)[1] for line in EXAMPLES.splitlines() if line.startswith("  ") and "=" in line
    ]
    named = [override for override in overrides if not override.startswith("python")]
    assert len(named) >= 8
    for override in named:
        compose([override])


def test_cfg_job_prints_the_config(line: Any) -> None:
    status, out, _ = line("--cfg", "job", "bias.d=2")
    assert status == 0
    assert OmegaConf.create(out).bias.d == 2


def test_a_reader_that_has_seen_enough_meets_no_traceback(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "simbias", *QUICK, "tracking=folders"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline().startswith("algorithm1 on bongoboard")
    process.stdout.close()
    assert "Error" not in process.stderr.read()
    assert process.wait(60) == 1
