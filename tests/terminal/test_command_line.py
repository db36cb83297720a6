"""The command line as a person uses it: a real process, a real store. Some start from nothing."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import OWN_CONF, POINT_MASS, PYTHONPATH, ROOT
from omegaconf import OmegaConf
from sweeping import simbias

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


def test_success_exits_0_and_says_how_many_experiments(tmp_path: Path) -> None:
    done = from_nothing(*QUICK, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Succeeded after 2 hardware experiments (1 iteration, " in done.stdout
    assert "mlflow ui --workers 1 --backend-store-uri sqlite:///mlflow.db" in done.stdout
    assert (tmp_path / "mlflow.db").exists()
    assert "Traceback" not in done.stderr


def test_failure_exits_1_and_says_why(tmp_path: Path) -> None:
    done = simbias(
        "task.horizon=3000", "optimizer.max_evaluations=3", "method.max_iterations=1", "tracking=none",
        folder=tmp_path,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "Did not succeed after 2 hardware experiments" in done.stdout
    assert "last failure: " in done.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("override", ["bias.d=abc", "optimizer=unknown", "nosuch=1"])
def test_bad_input_exits_2_with_one_line(tmp_path: Path, override: str) -> None:
    done = from_nothing(override, folder=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_bad_store_is_bad_input(tmp_path: Path) -> None:
    done = simbias(*QUICK, "tracking.uri=sqlite:////no/such/folder/mlflow.db", folder=tmp_path)
    assert done.returncode == 2
    assert "tracking.uri" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_issue_example_swaps_components(tmp_path: Path) -> None:
    done = simbias(
        *QUICK, "bias=none", "hardware.noise.torque_variance=0.1", "hardware.inertia_error=0.2",
        "optimizer=nlopt_crs", "seed=3", "tracking=none", folder=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "bias none, optimizer nlopt_crs" in done.stdout
    assert "seed 3" in done.stdout


def test_own_components_run(tmp_path: Path) -> None:
    done = simbias("--config-dir", str(OWN_CONF), *POINT_MASS, "tracking=none", folder=tmp_path)
    assert done.returncode == 0, done.stderr


def test_help_is_quick_and_complete(tmp_path: Path) -> None:
    start = time.perf_counter()
    done = from_nothing("--help", folder=tmp_path)
    assert time.perf_counter() - start < 1.5
    assert done.returncode == 0
    for folder in (path for path in (ROOT / "conf").iterdir() if path.is_dir()):
        (line,) = re.findall(rf"^  {folder.name} +(.+)$", done.stdout, re.MULTILINE)
        assert sorted(line.split(" | ")) == sorted(file.stem for file in folder.glob("*.yaml"))
    for word in ("  optimizer      nlopt_direct | ", "  bias           gp | ", "hardware.inertia_error=0.2"):
        assert word in done.stdout


def test_values_that_help_names_exist(tmp_path: Path) -> None:
    """What --help advertises composes."""
    from simbias.__main__ import EXAMPLES
    from simbias.config import compose

    overrides = [
        re.split("  +", line)[1] for line in EXAMPLES.splitlines() if line.startswith("  ") and "=" in line
    ]
    named = [override for override in overrides if not override.startswith("python")]
    assert len(named) >= 8
    for override in named:
        compose([override])


def test_cfg_job_prints_the_config(tmp_path: Path) -> None:
    done = from_nothing("--cfg", "job", "bias.d=2", folder=tmp_path)
    assert done.returncode == 0
    assert OmegaConf.create(done.stdout).bias.d == 2


def test_a_reader_that_has_seen_enough_meets_no_traceback(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "simbias", "+sweep=table2", "sweep.dry_run=true"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline().startswith("missing")
    process.stdout.close()
    assert "Error" not in process.stderr.read()
    assert process.wait(60) == 1
