"""What dead processes left is removed, what others hold is not."""

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import OWN_CONF, POINT_MASS

from simbias.__main__ import main
from simbias.engine import workplace


@pytest.fixture
def left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that a process left."""
    monkeypatch.setattr(workplace, "gettempdir", lambda: str(tmp_path))
    folder = tmp_path / "simbias-workers-1-x1"
    folder.mkdir()
    (folder / workplace.LOCK).touch()
    (folder / "spill").touch()
    return folder


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_leftovers_of_the_dead_are_removed(left: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also by a trial that has ended, which writes nothing, so that it makes no folder of its own."""
    monkeypatch.chdir(left.parent)
    command = [*POINT_MASS, "--config-dir", str(OWN_CONF), "tracking=folders", "tracking.pictures=false"]
    command += ["optimizer.max_evaluations=5", "method.max_iterations=1", "bias=none"]
    for _ in range(2):
        left.mkdir(exist_ok=True)
        (left / workplace.LOCK).touch()
        main(command)
        assert not left.exists()


def test_what_is_held_or_not_provably_ours_stays(left: Path) -> None:
    parent = left.parent
    paths = [parent / "joblib_memmapping_folder_1_x", parent / "simbias-workers-1-x"]  # without a lock
    for path in paths:
        path.mkdir()
    (parent / "simbias-workers-1-link").symlink_to(paths[0])
    with (left / workplace.LOCK).open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        workplace.tidy()
    assert all(path.exists() for path in (*paths, left / "spill"))


def test_a_folder_is_private_and_goes_with_its_process(tmp_path: Path) -> None:
    """While it lives, its lock is held."""
    program = (
        "from simbias.engine.workplace import tidy, workplace as w; w(); tidy(); "
        "print(w(), w() == w(), oct(w().stat().st_mode))"
    )
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    folder, same, mode = done.stdout.split()
    assert (same, mode, done.stderr) == ("True", "0o40700", "")
    assert Path(folder).parent == tmp_path
    assert not Path(folder).exists()
