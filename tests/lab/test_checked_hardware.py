"""Whatever a hardware does, an experiment ends in a rollout or in one line."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import PYTHONPATH
from faulty_hardware import CONVERTED, LEFT, RAISED, RETURNED
from hardware import Doing
from labs import THETA
from processes import INTERRUPTIBLE, wait_for
from records import assert_equal

from simbias.core import Hardware, HardwareError, Policy, Waiting
from simbias.core.messages import LONGEST_VALUE
from simbias.core.records import Array, Rollout
from simbias.lab import checked_hardware
from simbias.lab.checked_hardware import CheckedHardware, ExperimentConditions, MakeExperiment
from simbias.trial.study import Study

pytestmark = pytest.mark.slow

LINES = {
    "zero division": "run: expected a Rollout, got ZeroDivisionError: division by zero",
    "recursion": "run: expected a Rollout, got RecursionError: maximum recursion depth exceeded",
    "speechless": "run: expected a Rollout, got SpeechlessError: (its message cannot be read)",
    "no UTF-8": r"run: expected a Rollout, got OSError: caf\udce9 \x07 red",
    "long": "run: expected a Rollout, got RuntimeError: xxx",
    "exit": "run: expected a Rollout, got SystemExit: 7",
    "cancelled": "run: expected a Rollout, got CancelledError",
    "own words": "the battery is empty",
    "None": "run: expected a Rollout, got NoneType",
    "list": "run: expected a Rollout, got list",
    "dict": "run: expected a Rollout, got dict",
    "another class": "run: expected a Rollout, got SimpleNamespace",
    "columns": "run: states: expected the shape (101, 2), got (101, 1)",
    "flat": "run: inputs: expected the shape (k, 1), got (100,)",
    "ragged": "run: states: expected the shape (101, 2), got [[0.0], [0.0, 0.0], [0.0],",
    "too short": "run: states: expected the shape (99, 2), got (101, 2)",
    "nothing measured": "run: measured: expected the shape (101, 2), got (0, 6)",
    "another rate": "run: inputs: expected at most 100 frames of 0.02 s, got 200; does it run at",
    "ended early": "run: ended after 50 of 100 frames without a failure; report one in failed_at and failure",
    "NaN": "run: states: expected finite numbers, got [nan, ",
    "absurd": "run: states: expected numbers up to 1e+15, got [-1e+300, ",
    "elsewhere": "run: states: expected position to begin at 0.503456 m, within 20 dev",
    "a class of its own": "run: expected a Rollout, got KeyError: 'no connection'",
    "complex": "run: states: expected real numbers, got complex128",
    "object": "run: states: expected real numbers, got object",
    "text": "run: inputs: expected real numbers, got <U3",
    "masked": "run: states: expected finite numbers, got [",
    "masked row": "run: inputs: expected finite numbers, got [nan] in frame 0",
    "frame": "run: failed_at: expected a frame or None, got 'late'",
    "wrong frame": "run: failed_at: expected 100, the last frame, got 3",
    "failure": "run: failure: expected a name or None, got 3",
    "no frame of failure": "run: failure: expected None without failed_at, got 'distance'",
    "sensed": "run: sensed: expected true or false, got 'yes'",
}


def experiment(study: Study, fault: Callable[[Rollout], Any], timeout: float | None = None) -> Rollout:
    doing = replace(study, hardware=Doing(study.hardware, fault), conditions=ExperimentConditions(timeout))
    return doing.experiment(THETA, np.random.default_rng(1))


def test_a_fault_is_one_line(point_mass: Study) -> None:
    """It names component, field, what was expected and what came; what is raised in a thread, too."""
    assert LINES.keys() == {*RAISED, *RETURNED}
    for fault, timeout in [*product(LINES, [None]), *product(RAISED, [60.0])]:
        expected = LINES[fault]
        with pytest.raises(HardwareError) as caught:
            experiment(point_mass, (RAISED | RETURNED)[fault], timeout)
        line = str(caught.value)
        assert line.startswith(expected if fault == "own words" else f"Doing.{expected}"), fault
        assert line.isprintable(), fault
        assert len(line) < 350, fault


def test_what_can_be_converted_without_loss_is(point_mass: Study) -> None:
    unchanged = experiment(point_mass, lambda rollout: rollout)
    for fault, convert in CONVERTED.items():
        made, plain = experiment(point_mass, convert), unchanged
        if fault == "float32":
            assert not np.isnan(made.cost)
            rounded = plain.inputs.astype(np.float32).astype(np.float64)
            plain = replace(plain, inputs=rounded, cost=made.cost)
        assert_equal(made, plain, fault)
        for array in (made.states, made.inputs):
            assert array.dtype == np.float64
            assert array.flags.c_contiguous
        assert (type(made.sensed), type(made)) == (bool, Rollout)


class Memory:
    """A record of experiments in memory."""

    def __init__(self, kept: Sequence[Rollout] = ()) -> None:
        self.kept, self.refused = list(kept), []
        self._replayed = iter(kept)

    def experiment(self, theta: Array, rng: np.random.Generator, make: MakeExperiment) -> Rollout:
        rollout = next(self._replayed, None)
        if rollout is None:
            rollout = make(rng)
            self.kept.append(rollout)
        return rollout

    def refuse(self, returned: Any, theta: Array, start: Array, why: str) -> str:
        self.refused.append(returned)
        return "; it is kept"


def test_a_record_replays_keeps_and_takes_what_is_refused(point_mass: Study) -> None:
    """A replayed experiment is not made: nobody is asked, and the hardware rests."""
    task, policy, record, asked = point_mass.task, point_mass.policy, Memory(), []
    conditions = ExperimentConditions(confirm=True, ask=lambda *asked_for: not asked.append(asked_for))
    faults = iter([lambda rollout: rollout, RETURNED["NaN"]])
    hardware = Doing(point_mass.hardware, lambda rollout: next(faults)(rollout))
    checked = CheckedHardware(hardware, task, conditions, record)
    first = checked.run(policy, THETA, task.start_mean, np.random.default_rng(1))
    assert first is record.kept[0]
    np.testing.assert_array_equal(first.parameters, THETA)
    with pytest.raises(HardwareError, match=r"expected finite numbers, got .*; it is kept$"):
        checked.run(policy, THETA, task.start_mean, np.random.default_rng(2))
    assert np.isnan(record.refused[0].states).any()
    assert (len(record.kept), len(asked)) == (1, 1)
    again = CheckedHardware(hardware, task, conditions, Memory(record.kept))
    assert again.run(policy, THETA, task.start_mean, np.random.default_rng(1)) is first
    assert len(asked) == 1


def test_an_experiment_may_have_no_frame_and_its_failure_any_name(point_mass: Study) -> None:
    def fell(rollout: Rollout) -> Rollout:
        return Rollout(rollout.states[:1].tolist(), [], failed_at=0.0, failure="")  # type: ignore[arg-type]

    made = experiment(point_mass, fell)
    assert (made.states.shape, made.inputs.shape) == ((1, 2), (0, 1))
    assert (made.failed_at, type(made.failed_at), made.failure) == (0, int, "failed")
    for name, stored in (("caf\udce9\0", r"caf\udce9\x00"), (" \n", "failed"), (100_000 * "x", None)):
        made = experiment(point_mass, partial(replace, failed_at=100, failure=name))
        assert made.failure == stored or (stored is None and len(str(made.failure)) <= LONGEST_VALUE)


def test_a_hardware_that_writes_into_what_it_gets_changes_no_record(point_mass: Study) -> None:
    class Writing(Doing):
        def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Any:
            rollout = super().run(policy, theta, start, rng)
            theta[:], start[:] = np.nan, np.nan
            return rollout

    theta = THETA.copy()
    writing = replace(point_mass, hardware=Writing(point_mass.hardware, lambda rollout: rollout))
    made = writing.experiment(theta, np.random.default_rng(1))
    np.testing.assert_array_equal(theta, THETA)
    assert_equal(made, experiment(point_mass, lambda rollout: rollout))


def test_a_process_that_the_hardware_forks_does_not_go_on_here(point_mass: Study, tmp_path: Path) -> None:
    """It would run the rest of the trial, too, and write into the same files."""
    forker = os.getpid()
    for fault, timeout in product(("fork", "fork that raises"), (None, 60.0)):
        try:
            experiment(point_mass, LEFT[fault], timeout)
        finally:
            if os.getpid() != forker:
                (tmp_path / "goes on").touch()
                os._exit(0)
        os.waitpid(-1, 0)
        assert not (tmp_path / "goes on").exists()


def test_a_limit_changes_no_experiment_and_waiting_passes(point_mass: Study) -> None:
    seen = []

    def look(rollout: Rollout) -> Rollout:
        seen.append((np.geterr()["over"], threading.current_thread() is threading.main_thread()))
        return rollout

    def wait(rollout: Rollout) -> Rollout:
        raise Waiting("until Monday")

    with np.errstate(all="raise"):
        assert_equal(experiment(point_mass, look, 60.0), experiment(point_mass, look))
    assert seen == [("raise", False), ("raise", True)]
    for timeout in (None, 60.0):
        with pytest.raises(Waiting, match="until Monday"):
            experiment(point_mass, wait, timeout)


def test_an_experiment_that_does_not_end_is_stopped_and_how_that_went_is_told(
    point_mass: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checked_hardware, "STOP_SECONDS", 0.1)
    end = threading.Event()

    def wait(rollout: Rollout) -> Rollout:
        end.wait(60.0)
        return rollout

    def broken(self: Hardware) -> None:
        raise OSError("no answer")

    for name, stop, words in (
        ("Deaf", lambda self: None, "was called, but the experiment still runs"),
        ("Broken", broken, "raised OSError: no answer"),
        ("Stuck", lambda self: end.wait(60.0), "did not end within 0.1 s either"),
        ("Obeying", lambda self: end.set(), "was called, and the experiment ended"),
    ):
        hardware = type(name, (Doing,), {"stop": stop})(point_mass.hardware, wait)
        hanging = replace(point_mass, hardware=hardware, conditions=ExperimentConditions(0.1))
        begun = time.monotonic()
        with pytest.raises(HardwareError) as caught:
            hanging.experiment(THETA, np.random.default_rng(1))
        line = r"run: expected an end within 0.1 s (experiment_timeout), got none; "
        assert str(caught.value) == f"{name}.{line}{name}.stop {words}"
        assert 0.1 <= time.monotonic() - begun < 2.0


LOOPS = """
import time
from pathlib import Path
import numpy as np
from point_mass import PointMass, Spring
from simbias.core import Hardware
from simbias.lab.checked_hardware import CheckedHardware, ExperimentConditions

class Arm(Hardware):
    def __init__(self, seconds, name):
        self.seconds, self.name = seconds, name

    def run(self, policy, theta, start, rng):
        try:
            Path(f"{self.name} begun").touch()
            if self.seconds:
                while True: time.sleep(self.seconds)
            while True: pass
        finally:
            Path(f"{self.name} at rest").touch()

    def stop(self):
        Path(f"{self.name} stopped").touch()

task = PointMass()
policy = Spring(task)
for timeout in (None, 60.0):
    for seconds in (0.01, 0.0):
        name, conditions = f"{timeout} {seconds}", ExperimentConditions(timeout=timeout)
        hardware = CheckedHardware(Arm(seconds, name), task, conditions)
        try:
            hardware.run(policy, np.zeros(3), np.zeros(2), np.random.default_rng(0))
        except KeyboardInterrupt:
            Path(f"{name} interrupted").touch()
"""


def test_ctrl_c_ends_an_experiment(tmp_path: Path) -> None:
    """Within 2 s, asleep or not, with a limit or without: it is stopped, and does what it does at last."""
    environment = os.environ | {"PYTHONPATH": PYTHONPATH}
    process = subprocess.Popen([sys.executable, "-c", INTERRUPTIBLE + LOOPS], cwd=tmp_path, env=environment)
    for name in ("None 0.01", "None 0.0", "60.0 0.01", "60.0 0.0"):
        wait_for(lambda name=name: (tmp_path / f"{name} begun").exists())
        process.send_signal(signal.SIGINT)
        left = {f"{name} {what}" for what in ("begun", "at rest", "stopped", "interrupted")}
        wait_for(lambda name=name, left=left: {path.name for path in tmp_path.glob(f"{name} *")} == left, 2.0)
    assert process.wait(10) == 0
