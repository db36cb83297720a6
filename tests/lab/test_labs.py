"""Hardware that is a person or a program: orders go out, trajectories come back."""

from __future__ import annotations

import json
import os
import shlex
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS, ROOT
from point_mass import InTheWind, PointMass, Spring

from simbias.__main__ import BAD_INPUT, FAILED, SUCCEEDED, WAITING, main
from simbias.config import ConfigError, compose
from simbias.config.build import build
from simbias.core import HardwareError, Waiting
from simbias.core.records import Rollout
from simbias.lab.requests.manual import Manual
from simbias.lab.requests.process import Process
from simbias.lab.requests.trajectory import header
from simbias.trial.study import Study

EXAMPLE = ROOT / "notebooks" / "examples" / "echo_robot.py"
THETA = np.array([4.0, 4.0, -2.0])
OWN = [*(each for each in POINT_MASS if "hardware" not in each), "optimizer.max_evaluations=40"]


def answer(folder: Path) -> None:
    """Do what an order says, as a lab that reads policy.json alone."""
    order = json.loads((folder / "policy.json").read_text())
    task = PointMass(order["time_step"], order["frames"])
    start = np.array([state["start"] for state in order["states"]])
    parameters = np.array(order["policy"]["parameters"])
    made = InTheWind(task).run(Spring(task), parameters, start, np.random.default_rng(0))
    times = task.time_step * np.arange(len(made.states))
    inputs = np.concatenate([made.inputs, [[0.0]]])
    rows = np.column_stack([times, made.states, inputs]).tolist()
    lines = [",".join(header(task)), *(",".join(map(repr, row)) + "," for row in rows)]
    (folder / "trajectory.csv").write_text("\n".join(lines))


@pytest.mark.slow
def test_a_trial_waits_for_a_person_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Order by order, with a wrong file between; it ends as the trial on the simulated hardware."""
    monkeypatch.chdir(tmp_path)
    store = [f"tracking.uri=sqlite:///{tmp_path}/mlflow.db", "tracking.pictures=false"]
    command = ["--config-dir", str(OWN_CONF), "--allow", "point_mass", *OWN, "hardware=manual", *store]
    status, answered = main(command), 0
    while status == WAITING:
        error = capsys.readouterr().err
        (folder,) = (path for path in Path("orders").iterdir() if not (path / "trajectory.csv").exists())
        assert f"make the experiment of {folder}/README.txt, and put its trajectory.csv there" in error
        assert f"({answered} hardware experiment{'s' * (answered != 1)} kept; go on with:  " in error
        assert {path.name for path in folder.iterdir()} == {"README.txt", "policy.json", "template.csv"}
        assert "has no kernel" in (folder / "README.txt").read_text()
        if answered == 1:
            (folder / "trajectory.csv").write_text("time (s),position (m)\n0,0\n")
            assert main(command) == FAILED
            line = capsys.readouterr().err
            assert f"{folder}/trajectory.csv: row 1: expected a column velocity (m/s), got none" in line
            assert "(1 hardware experiment kept; " in line
        answer(folder)
        answered += 1
        status = main(command)
    assert status == SUCCEEDED
    simulated = list(build(compose([*OWN, "hardware=point_mass"], OWN_CONF)).run())
    assert answered == simulated[-1].total_experiments == len(list(Path("orders").iterdir()))
    assert f"Succeeded after {answered} hardware experiments" in capsys.readouterr().out


def test_the_same_experiment_has_the_same_order_anywhere(point_mass: Study, tmp_path: Path) -> None:
    """An order that was written elsewhere is found by its name, whatever its number; others are others."""
    for place in ("here", "there"):
        hardware = Manual(point_mass.task, str(tmp_path / place))
        for seed in (3, 4, 3):
            with pytest.raises(Waiting, match=r"README\.txt"):
                hardware.run(point_mass.policy, THETA, np.zeros(2), np.random.default_rng(seed))
    names = [sorted(path.name for path in (tmp_path / place).iterdir()) for place in ("here", "there")]
    assert names[0] == names[1]
    assert len(names[0]) == 2
    assert not list(tmp_path.glob("*/.*"))


def test_orders_that_cannot_be_written_are_one_line(point_mass: Study, tmp_path: Path) -> None:
    (tmp_path / "orders").touch()
    hardware = Manual(point_mass.task, str(tmp_path / "orders"))
    with pytest.raises(HardwareError, match=r"orders: the order cannot be written"):
        hardware.run(point_mass.policy, THETA, np.zeros(2), np.random.default_rng(0))


def program(folder: Path, text: str) -> str:
    """The command of a program."""
    (folder / "program.py").write_text(f"import json, sys, time\norder = json.load(sys.stdin)\n{text}\n")
    return shlex.join([sys.executable, str(folder / "program.py")])


def run(study: Study, command: str, timeout: float = 30.0) -> Rollout:
    hardware = Process(study.task, command, timeout)
    start = np.array([0.5, 0.01])
    return replace(study, hardware=hardware).experiment(THETA, np.random.default_rng(1), start)


def test_the_example_is_the_hardware_in_the_wind(
    point_mass: Study, capsys: pytest.CaptureFixture[str]
) -> None:
    made = run(point_mass, shlex.join([sys.executable, str(EXAMPLE)]))
    expected = point_mass.experiment(THETA, np.random.default_rng(1), np.array([0.5, 0.01]))
    np.testing.assert_allclose(made.states, expected.states, rtol=1e-12)
    np.testing.assert_allclose(made.inputs, expected.inputs, rtol=1e-12)
    assert made.sensed
    assert capsys.readouterr().err == "the example has run\n"


ROWS = "states = [[0.01, 0.0]] * 101; inputs = [[0.0]] * 101;"
ANSWERS = {
    "print('{}')": "expected an object with states and inputs, got {}",
    "print('hello')": r"expected one JSON object, got 'hello\n'",
    "print('')": r"expected one JSON object, got '\n'",
    "sys.exit('the arm is not there')": "expected exit status 0, got 1: the arm is not there",
    "sys.exit(4)": "expected exit status 0, got 4: it says nothing",
    f"{ROWS} print(json.dumps(dict(states=states)))": "expected an object with states and inputs",
    f"{ROWS} print(json.dumps(dict(states=[[0.0]], inputs=inputs)))": "states: expected rows of 2 numbers",
    f"{ROWS} print(json.dumps(dict(states=states, inputs='no')))": "inputs: expected rows of 1 numbers",
    f"{ROWS} print(json.dumps(dict(states=states, inputs=inputs[:50])))": "expected as many rows, got 101",
    f"{ROWS} states[3] = [float('nan'), 0]; print(json.dumps(dict(states=states, inputs=inputs)))": (
        "states: row 4: expected finite numbers, got [nan, 0.0]"
    ),
    f"{ROWS} print(json.dumps(dict(states=states, inputs=inputs, failure=1)))": "failure: expected a name",
    f"{ROWS} print(json.dumps(dict(states=states, inputs=inputs, cost=1)))": "cost: expected states, inputs",
    f"{ROWS} print(json.dumps(dict(states=states[:60], inputs=inputs[:60])))": (
        "row 60: expected 100 frames of 0.02 s, the recording ends after 59 without a failure"
    ),
    f"{ROWS} print(json.dumps(dict(states=states, inputs=inputs, times=[0.1 * i for i in range(101)])))": (
        "column time: expected a row at least every 0.02 s (50 Hz), got one every 0.1 s (10 Hz)"
    ),
    f"{ROWS} print(json.dumps(dict(states=states, inputs=inputs, times=3)))": (
        "times: expected rows of 1 numbers, got the shape ()"
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("text", ANSWERS)
def test_what_is_no_trajectory_is_one_line(point_mass: Study, tmp_path: Path, text: str) -> None:
    with pytest.raises(HardwareError) as caught:
        run(point_mass, program(tmp_path, text))
    line = str(caught.value)
    assert ANSWERS[text] in line
    assert line.startswith("Process ")
    assert line.isprintable()


def test_an_answer_at_a_higher_rate_is_resampled(point_mass: Study, tmp_path: Path) -> None:
    text = (
        "times = [0.01 * i for i in range(201)]; "
        "inputs = [[1.0], [3.0]] * 100 + [[1.0]]; "
        "print(json.dumps(dict(times=times, states=[[0.1, 0.0]] * 201, inputs=inputs)))"
    )
    made = run(point_mass, program(tmp_path, text))
    np.testing.assert_allclose(made.inputs, np.full((100, 1), 2.0))


def test_a_program_may_wait(point_mass: Study, tmp_path: Path) -> None:
    with pytest.raises(Waiting, match=r"^charge the battery$"):
        run(point_mass, program(tmp_path, "print(json.dumps({'waiting': 'charge the battery'}))"))


@pytest.mark.slow
def test_a_program_that_takes_too_long_is_ended_with_its_children(point_mass: Study, tmp_path: Path) -> None:
    text = (
        "import subprocess; child = subprocess.Popen(['sleep', '60']); "
        f"open({str(tmp_path / 'child')!r}, 'w').write(str(child.pid)); time.sleep(60)"
    )
    begun = time.monotonic()
    with pytest.raises(HardwareError, match=r"expected an answer within 1 s \(hardware\.timeout\), got none"):
        run(point_mass, program(tmp_path, text), 1.0)
    assert time.monotonic() - begun < 10
    child = int((tmp_path / "child").read_text())
    for _ in range(100):  # until the system has let go of it
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    assert Path(f"/proc/{child}/stat").read_text().split()[2] == "Z"  # ended, and nobody has asked


def test_a_program_that_is_not_there_is_one_line(point_mass: Study) -> None:
    with pytest.raises(HardwareError, match=r"^Process nosuchprogram: cannot be started \("):
        run(point_mass, "nosuchprogram")


@pytest.mark.parametrize(
    ("override", "message"),
    [("hardware.command=''", "hardware: command is empty"), ("seed=0", "hardware.command")],
)
def test_a_program_has_to_be_named(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(compose(["hardware=process", override]))
    assert main(["hardware=process", override, "tracking=none"]) == BAD_INPUT
