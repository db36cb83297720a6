"""What is installed carries configs, sweeps and published CSVs, no pictures, and needs no checkout."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import OWN_CONF, ROOT
from hatchling.builders.wheel import WheelBuilder
from test_readme import COMMANDS, README, shortened

pytestmark = pytest.mark.slow

LARGEST = 1_000_000  # bytes


PROGRAM = """
import ast, sys
import simbias
from simbias.__main__ import main

print("home", simbias.__file__)
for arguments in ast.literal_eval(sys.argv[1]):
    try:
        status = main(arguments)
    except SystemExit as end:  # of --help
        status = end.code
    print("status", status, flush=True)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, as it is published."""
    folder = str(tmp_path_factory.mktemp("wheel"))
    return Path(next(WheelBuilder(str(ROOT)).build(directory=folder, versions=["standard"])))


def test_it_carries_what_commands_read_and_no_pictures(wheel: Path) -> None:
    assert wheel.stat().st_size < LARGEST
    names = set(zipfile.ZipFile(wheel).namelist())
    read = [*ROOT.glob("conf/**/*.yaml"), *ROOT.glob("sweeps/*.yaml"), *ROOT.glob("sweeps/results/*/*.csv")]
    assert len(read) > 100
    assert {f"simbias/{file.relative_to(ROOT).as_posix()}" for file in read} <= names
    assert {Path(name).suffix for name in names if name.startswith("simbias/")} == {
        *(".csv", ".md", ".py", ".xml", ".yaml"),
    }
    assert not [name for name in names if name.startswith("simbias/sweeps/studies")]


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment whose simbias is the wheel's."""
    target = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target"]
    subprocess.run([*pip, str(target), str(wheel)], check=True)
    compiled = ROOT / "simbias" / "__pycache__"  # by other tests
    return os.environ | {"PYTHONPATH": str(target), "NUMBA_CACHE_DIR": str(compiled)}


def commands() -> Iterator[list[str]]:
    """README's commands, shortened, those that name no folder of the reader's."""
    for command in COMMANDS:
        arguments = [word for word in shortened(command) if not word.startswith("tracking.")]
        if command in README and str(OWN_CONF) not in arguments:
            keeps = not {"--help", "new", "check"} & set(arguments)
            yield [*arguments, *(["tracking=none"] if keeps else [])]


def test_readmes_commands_run_from_an_empty_folder(installed: dict[str, str], tmp_path: Path) -> None:
    """One after the other in one process, as a new one takes seconds."""
    wanted = [arguments for _, _, *arguments in commands()]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, repr(wanted)],
        cwd=tmp_path,
        env=installed,
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"home {installed['PYTHONPATH']}" in done.stdout
    statuses = re.findall(r"^status (\d)$", done.stdout, re.MULTILINE)
    assert len(statuses) == len(wanted) > 5
    assert set(statuses) <= {"0", "1", "3"}, done.stderr  # a trial may fail, or wait
    assert "Traceback" not in done.stderr
