"""A program as the hardware: it answers, or is one line; it never runs on alone, and never beside another."""

import json
import os
import resource
import shlex
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np
import pytest
from conftest import ROOT
from labs import THETA
from point_mass import PointMass, Spring
from processes import runs, wait_for

from simbias.config import ConfigError, compose
from simbias.config.build import build
from simbias.core import HardwareError, Waiting
from simbias.core.records import Rollout
from simbias.lab.checked_hardware import CheckedHardware, ExperimentConditions
from simbias.lab.requests import process
from simbias.lab.requests.process import Process
from simbias.lab.requests.program import alone
from simbias.trial.run import run_trial
from simbias.trial.study import Study

pytestmark = pytest.mark.slow

EXAMPLE = ROOT / "notebooks" / "examples" / "echo_robot.py"
START = np.array([0.5, 0.01])


def program(folder: Path, text: str) -> str:
    """The command of a program that knows its request."""
    (folder / "program.py").write_text(
        f"import json, os, signal, subprocess, sys, time\nrequest = json.load(sys.stdin)\n{text}\n"
    )
    return shlex.join([sys.executable, "-S", str(folder / "program.py")])


def run(study: Study, command: str, timeout: float = 30.0) -> Rollout:
    hardware = Process(study.task, command, timeout)
    return replace(study, hardware=hardware).experiment(THETA, np.random.default_rng(1), START)


def test_the_example_is_the_hardware_in_the_wind(
    point_mass: Study, capsys: pytest.CaptureFixture[str]
) -> None:
    made = run(point_mass, shlex.join([sys.executable, str(EXAMPLE)]))
    expected = point_mass.experiment(THETA, np.random.default_rng(1), START)
    np.testing.assert_allclose(made.states, expected.states, rtol=1e-12)
    np.testing.assert_allclose(made.inputs, expected.inputs, rtol=1e-12)
    assert made.sensed
    assert capsys.readouterr().err == "the example has run\n"


ROWS = "states = [[0.5, 0.0]] * 101; inputs = [[0.0]] * 101; failure = None; times = None"
ANSWER = "print(json.dumps(dict(states=states, inputs=inputs, failure=failure, times=times)))"
ANSWERS = {
    "print('{}')": "expected an object with states and inputs, got {}",
    "print('hello')": r"expected one JSON object, got 'hello\n'",
    "print('[' * 100000)": "expected one JSON object, got '[[[",
    "sys.exit('the arm is not there')": "expected exit status 0, got 1: the arm is not there",
    "os.kill(os.getpid(), 9)": "expected exit status 0, got 137: it printed no message",
    "print(json.dumps(dict(states=states, inputs=inputs, cost=1)))": "cost: expected only states, inputs",
    f"inputs = [['1_2']] * 101; {ANSWER}": "inputs: row 1: expected 1 finite number, got ['1_2']",
    f"inputs = inputs[:50]; {ANSWER}": "expected equally many rows of each, got 101",
    f"states = inputs = []; {ANSWER}": "states: expected at least one row, got none",
    f"states[3] = [0.5]; {ANSWER}": "states: row 4: expected 2 finite numbers, got [0.5]",
    f"states[3] = [10**400, 0]; {ANSWER}": "states: row 4: expected 2 finite numbers, got [1000",
    f"states[3] = [float('nan'), 0]; {ANSWER}": "states: row 4: expected 2 finite numbers, got [nan, 0",
    f"failure = 1; {ANSWER}": "failure: expected a name",
    f"times = [0.1 * i for i in range(101)]; {ANSWER}": "column time: expected a row at least every 0.02 s",
    f"times = 3; {ANSWER}": "times: expected rows of 1 numbers",
}


def test_what_is_no_trajectory_is_one_line(point_mass: Study, tmp_path: Path) -> None:
    for text, expected in ANSWERS.items():
        with pytest.raises(HardwareError) as caught:
            run(point_mass, program(tmp_path, f"{ROWS}\n{text}"))
        line = str(caught.value)
        assert expected in line
        assert line.startswith("Process "), text
        assert line.isprintable(), text
    with pytest.raises(HardwareError, match="got 1: it printed no message"):
        run(point_mass, "false")  # it need not read its request
    for command in ("nosuchprogram", str(tmp_path)):
        with pytest.raises(HardwareError, match=r"^Process .*: expected exit .* 127: cannot be started \("):
            run(point_mass, command)
    for override, message in (("hardware.command=''", "command is empty"), ("seed=0", "hardware.command")):
        with pytest.raises(ConfigError, match=message):
            build(compose(["hardware=process", override]))


@pytest.mark.usefixtures("uncompiled")
def test_what_a_program_said_is_kept_if_it_is_no_rollout(point_mass: Study, tmp_path: Path) -> None:
    """The robot may have moved: nobody makes that experiment again to see what it was."""
    for number, text in enumerate((f"states[3][0] = float('nan'); {ANSWER}", f"{ANSWER}; sys.exit(3)")):
        hardware = Process(point_mass.task, program(tmp_path, f"{ROWS}\n{text}"))
        record = run_trial(replace(point_mass, hardware=hardware), tmp_path / "trial")
        kept = tmp_path / "trial" / f"refused_{number:04d}.json"
        assert record.summary.reason.endswith(f"; it is kept in {kept}")
        assert len(json.loads(json.loads(kept.read_text())["returned"])["states"]) == 101


def test_a_robot_may_fail_before_anything_acts(point_mass: Study, tmp_path: Path) -> None:
    text = f"{ROWS}; failure = 'stop'; states[1:] = inputs[:] = []; {ANSWER}"
    made = run(point_mass, program(tmp_path, text))
    assert (made.failed_at, made.failure, made.inputs.shape) == (0, "stop", (0, 1))
    made = run(point_mass, program(tmp_path, f"{ROWS}; failure = ''; {ANSWER}"))  # as its controller says it
    assert (made.failed_at, made.failure) == (None, None)


def test_an_answer_at_a_higher_rate_is_resampled_and_one_may_wait(point_mass: Study, tmp_path: Path) -> None:
    text = (
        "times = [0.01 * i for i in range(201)]; failure = None; "
        f"states, inputs = [[0.5, 0.0]] * 201, [[1.0], [3.0]] * 100 + [[1.0]]; {ANSWER}"
    )
    made = run(point_mass, program(tmp_path, text))
    np.testing.assert_allclose(made.inputs, np.full((100, 1), 2.0))
    with pytest.raises(Waiting, match=r"^charge the battery$"):
        run(point_mass, program(tmp_path, "print(json.dumps({'waiting': 'charge the battery'}))"))


def test_a_program_that_never_stops_printing_is_ended(point_mass: Study, tmp_path: Path) -> None:
    """In one line, and without filling the memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for stream in ("stdout", "stderr"):
        with pytest.raises(HardwareError, match="expected at most 64 MB of output, got more"):
            run(point_mass, program(tmp_path, f"while True: sys.{stream}.write('y' * 100000)"))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000  # KiB


STUBBORN = "signal.signal(signal.SIGTERM, signal.SIG_IGN)"


def test_a_program_that_takes_too_long_is_ended_with_its_children(point_mass: Study, tmp_path: Path) -> None:
    """It has time to bring the robot to rest; also a child that ignores SIGTERM is ended."""
    child = f"[sys.executable, '-S', '-c', 'import signal, time; {STUBBORN}; time.sleep(60)']"
    text = f"""
pids, at_rest = {str(tmp_path / "pids")!r}, {str(tmp_path / "at rest")!r}
signal.signal(signal.SIGTERM, lambda *_: (open(at_rest, "w"), sys.exit()))
child = subprocess.Popen({child})
open(pids, "w").write(f"{{os.getpid()}} {{child.pid}}")
time.sleep(60)
"""
    begun = time.monotonic()
    with pytest.raises(HardwareError, match=r"an answer within 2.5 s \(its own duration and hard"):
        run(point_mass, program(tmp_path, text), 0.5)
    assert time.monotonic() - begun < 6
    for pid in (tmp_path / "pids").read_text().split():
        wait_for(lambda pid=pid: not runs(int(pid)), 1.0)
    assert (tmp_path / "at rest").exists()
    assert run(point_mass, program(tmp_path, f"time.sleep(1); {ROWS}; {ANSWER}"), 0.5).frames == 100  # of 2 s


DRIVING = """
import fcntl, json, os, signal, sys, time
alone = open({alone!r}, "w")
fcntl.flock(alone, fcntl.LOCK_EX | fcntl.LOCK_NB)  # a robot has one driver, or this raises
open({pids!r}, "a").write(f"{{os.getpid()}} ")
{what}
time.sleep({seconds})
print(json.dumps(dict(states=[[0.5, 0.0]] * 101, inputs=[[0.0]] * 101)))
"""


@contextmanager
def simbias(command: str, timeout: float | None = None) -> Iterator[tuple[int, IO[str]]]:
    """A process, forked from this one, that makes an experiment by a program; and what it says at last."""
    end, own = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which rest
        pid = os.fork()
    if pid == 0:
        os.dup2(own, 2)
        try:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            task = PointMass()
            hardware = CheckedHardware(Process(task, command), task, ExperimentConditions(timeout=timeout))
            hardware.run(Spring(task), np.zeros(3), START, np.random.default_rng(0))
        except BaseException:
            os.write(2, traceback.format_exc().encode())
        finally:
            os._exit(0)
    os.close(own)
    with open(end, encoding="utf-8") as said:
        try:
            yield pid, said
        finally:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def driving(folder: Path, seconds: float, what: str = "") -> str:
    """The command of a program that drives a robot for so long, and notes its process."""
    text = DRIVING.format(alone=str(folder / "alone"), pids=str(folder / "pids"), seconds=seconds, what=what)
    (folder / "driving.py").write_text(text)
    return shlex.join([sys.executable, "-S", str(folder / "driving.py")])


def pids(folder: Path) -> list[int]:
    """The processes of the programs that have been started."""
    file = folder / "pids"
    return [int(each) for each in file.read_text().split()] if file.exists() else []


def test_a_program_dies_with_simbias_and_the_next_one_waits_for_its_end(
    point_mass: Study, tmp_path: Path
) -> None:
    """SIGKILL, and at once the same experiment again: two programs never drive the robot together."""
    command = driving(tmp_path, 60, STUBBORN)
    with simbias(command):
        wait_for(lambda: len(pids(tmp_path)) == 1)
    driving(tmp_path, 0.1)  # the same file, so the same command
    assert run(point_mass, command).frames == 100
    assert len(pids(tmp_path)) == 2
    assert not any(runs(pid) for pid in pids(tmp_path))


@pytest.mark.skipif(sys.platform != "linux", reason="no signal at a parent's death")
def test_a_program_dies_with_its_supervisor(point_mass: Study, tmp_path: Path) -> None:
    with simbias(driving(tmp_path, 60, STUBBORN)) as (parent, said):
        wait_for(lambda: len(pids(tmp_path)) == 1)
        (pid,) = pids(tmp_path)
        supervisor = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
        assert supervisor != parent
        os.kill(supervisor, signal.SIGKILL)
        wait_for(lambda: not runs(pid), 2.0)
        assert "expected exit status 0, got" in said.read()


def test_ctrl_c_ends_a_program(tmp_path: Path) -> None:
    """Within 2 s, also one that ignores SIGTERM; with a limit and without."""
    with ExitStack() as stack:
        started = []
        for timeout in (None, 60.0):
            folder = tmp_path / str(timeout)
            folder.mkdir()
            started.append((folder, *stack.enter_context(simbias(driving(folder, 60, STUBBORN), timeout))))
        wait_for(lambda: all(len(pids(folder)) == 1 for folder, _, _ in started))
        for _, pid, _ in started:
            os.kill(pid, signal.SIGINT)
        wait_for(lambda: not any(runs(pids(folder)[0]) for folder, _, _ in started), 2.0)
        assert all("KeyboardInterrupt" in said.read() for _, _, said in started)


def test_an_experiment_does_not_wait_for_ever_for_another_one(
    point_mass: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It names the process to end; programs that are no robot may run beside each other."""
    monkeypatch.setattr(process, "END_SECONDS", 0.1)
    command = driving(tmp_path, 60)
    with simbias(command):
        wait_for(lambda: len(pids(tmp_path)) == 1)
        with pytest.raises(HardwareError, match=r"still running for another experiment \(process ") as caught:
            run(point_mass, command, 0.1)
        holder = int(str(caught.value).partition("(process ")[2].partition(")")[0])
        assert runs(holder)
        shared = Process(point_mass.task, command, 2.0, exclusive=False)
        with pytest.raises(HardwareError, match="BlockingIOError"):  # of the program itself
            replace(point_mass, hardware=shared).experiment(THETA, np.random.default_rng(1), START)
        os.kill(holder, signal.SIGTERM)
        wait_for(lambda: not runs(pids(tmp_path)[0]), 2.0)


def test_a_robot_is_held_for_every_user_of_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In whatever environment: the lock lies where TMPDIR does not matter, and anybody may open it."""
    monkeypatch.setattr("simbias.lab.requests.program.LOCKS", str(tmp_path))
    for elsewhere in "one", "another":
        monkeypatch.setattr("tempfile.tempdir", elsewhere)
        with alone(["drive", "robot"], 0.1):
            (lock,) = tmp_path.iterdir()
            assert lock.stat().st_mode & 0o777 == 0o666
            with pytest.raises(HardwareError, match="still running"), alone(["drive", "robot"], 0.0):
                pass
