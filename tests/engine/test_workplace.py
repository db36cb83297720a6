"""What dead processes left is removed, what others hold is not."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from simbias.engine import workplace


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """A folder of temporary files and one of semaphores."""
    temporary, semaphores = tmp_path / "temporary", tmp_path / "semaphores"
    temporary.mkdir()
    semaphores.mkdir()
    monkeypatch.setattr(workplace, "gettempdir", lambda: str(temporary))
    monkeypatch.setattr(workplace, "SEMAPHORES", semaphores)
    return temporary, semaphores


def leave(places: tuple[Path, Path], pid: int) -> tuple[Path, Path]:
    """What a process may leave: a folder and a semaphore."""
    folder, semaphore = places[0] / f"simbias-workers-{pid}-x1", places[1] / f"sem.loky-{pid}-x2"
    folder.mkdir()
    (folder / workplace.LOCK).touch()
    (folder / "spill").touch()
    semaphore.touch()
    return folder, semaphore


def dead_pid() -> int:
    process = subprocess.Popen(["true"])
    process.wait()
    return process.pid


def test_leftovers_of_the_dead_are_removed(places: tuple[Path, Path]) -> None:
    left = leave(places, dead_pid())
    workplace.tidy()
    assert not any(path.exists() for path in left)


def test_a_held_lock_protects(places: tuple[Path, Path]) -> None:
    """Even if no such process is to be seen, as from within a container."""
    left = leave(places, dead_pid())
    with (left[0] / workplace.LOCK).open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        workplace.tidy()
    assert all(path.exists() for path in left)


def test_a_living_number_protects(places: tuple[Path, Path]) -> None:
    """Its process may be about to take the lock."""
    left = leave(places, os.getpid())
    workplace.tidy()
    assert all(path.exists() for path in left)


def test_what_is_not_provably_ours_stays(places: tuple[Path, Path]) -> None:
    temporary, semaphores = places
    pid = dead_pid()
    paths = [
        semaphores / f"sem.loky-{pid}-x",  # of another program: no folder of ours belongs to it
        temporary / f"joblib_memmapping_folder_{pid}_x",
        temporary / f"simbias-workers-{pid}-x",  # without a lock
    ]
    for path in paths:
        path.mkdir()
    (temporary / f"simbias-workers-{pid}-link").symlink_to(paths[2])
    workplace.tidy()
    assert all(path.exists() for path in paths)


def test_a_folder_is_private_and_goes_with_its_process(tmp_path: Path) -> None:
    program = (
        "from simbias.engine.workplace import workplace as w; print(w(), w() == w(), oct(w().stat().st_mode))"
    )
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    folder, same, mode = done.stdout.split()
    assert (same, mode, done.stderr) == ("True", "0o40700", "")
    assert Path(folder).parent == tmp_path
    assert not Path(folder).exists()
