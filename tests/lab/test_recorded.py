"""Recordings of a real robot in place of one."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from pendulum import pendulum

from simbias.core import HardwareError
from simbias.lab.recorded import ENDS, Recorded
from simbias.lab.table import read_table
from simbias.trial.study import Study


def test_experiments_are_the_recordings_in_turn() -> None:
    study = pendulum()
    first, second, third = (
        study.experiment(np.zeros(study.policy.n_parameters), rng)
        for rng in np.random.default_rng(0).spawn(3)
    )
    assert first.sensed
    np.testing.assert_array_equal(first.states, third.states)
    assert np.abs(first.states[:500] - second.states[:500]).max() > 0.1
    with gzip.open("tests/recordings/acrobot_01.csv.gz", "rt") as file:
        lines = file.read().split()
    start = [float(value) for value in lines[1].split(",")]
    np.testing.assert_allclose(first.states[0], start[1:5])
    np.testing.assert_allclose(first.inputs[0], start[5:])


def test_between_the_lines_it_is_linear(tmp_path: Path) -> None:
    names = "time,pos1,pos2,vel1,vel2,tau1,tau2"
    rows = [[t, t, 2 * t, 3 * t, 4 * t, 5 * t, 6 * t] for t in (5.0, 5.003, 5.0101)]
    (tmp_path / "line.csv").write_text("\n".join([names, *(",".join(map(str, row)) for row in rows)]))
    study = pendulum(f"hardware.folder={tmp_path}", "hardware.columns=null")
    rollout = study.experiment(np.zeros(study.policy.n_parameters), np.random.default_rng(0))
    assert (rollout.failed_at, rollout.failure) == (5, ENDS)
    at = 5.0 + 0.002 * np.arange(6)
    np.testing.assert_allclose(rollout.states, np.outer(at, [1, 2, 3, 4]), rtol=1e-12)
    np.testing.assert_allclose(rollout.inputs, np.outer(at[:-1], [5, 6]), rtol=1e-12)


def run(study: Study) -> None:
    study.hardware.run(study.policy, np.zeros(3), np.zeros(4), np.random.default_rng(0))


def test_what_cannot_be_read_is_told(tmp_path: Path) -> None:
    study = pendulum(f"hardware.folder={tmp_path}")
    with pytest.raises(HardwareError, match="no recording"):
        run(study)
    (tmp_path / "bad.csv").write_text("time,pos_meas1\n0,1\n")
    with pytest.raises(HardwareError, match="expected a column pos_meas2"):
        run(study)
    names = "time,pos_meas1,pos_meas2,vel_meas1,vel_meas2,tau_meas1,tau_meas2"
    (tmp_path / "bad.csv").write_text(f"{names}\n0,0,0,0,0,0,0\n0.01,0,1_2,0,0,0,0\n")
    with pytest.raises(HardwareError, match=r"bad\.csv: row 3, column pos_meas2: expected a finite number"):
        run(study)
    with pytest.raises(ValueError, match="columns names what the task has not: angle"):
        Recorded(study.task, str(tmp_path), columns={"angle": "q"})


def test_a_small_file_may_not_hold_more_than_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simbias.lab.table.LARGEST", 2**20)
    file = tmp_path / "zeros.csv.gz"
    file.write_bytes(gzip.compress(bytes(2**21)))
    assert file.stat().st_size < 2**14
    with pytest.raises(HardwareError, match=r"zeros\.csv\.gz: holds more than 1 MiB"):
        read_table(file)
