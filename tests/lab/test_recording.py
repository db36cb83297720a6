"""Recordings as labs have them: units, rates, gaps, what lacks; ROS bags, MCAP; and in place of a robot."""

import gzip
import re
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from errors import one_line
from pendulum import experiment, pendulum

from simbias.core import HardwareError
from simbias.core.records import Rollout
from simbias.lab.recorded import ENDS, Recorded
from simbias.lab.recording import Reader, Recording
from simbias.lab.table import read_table
from simbias.lab.units import factor
from simbias.trial.observer import Observer
from simbias.trial.study import Study

NAMES = ["time", "pos1", "pos2", "vel1", "vel2", "tau1", "tau2"]


@pytest.fixture(scope="module")
def study() -> Study:
    return pendulum()


@pytest.fixture(scope="module")
def rollout(study: Study) -> Rollout:
    """Two seconds without noise."""
    return experiment(study.nominal, np.random.default_rng(0), 1000, np.zeros(4))


def frame(rollout: Rollout) -> pd.DataFrame:
    """It as a table with the task's own names."""
    time = 0.002 * np.arange(rollout.frames)
    return pd.DataFrame(np.column_stack([time, rollout.states[:-1], rollout.inputs]), columns=NAMES)


def read(study: Study, table: pd.DataFrame, folder: Path, **columns: str) -> Recording:
    """The recording of a table, as a CSV file."""
    table.to_csv(folder / "one.csv", index=False)
    return Reader(study.task, {name: columns.get(name, name) for name in NAMES}).read(folder / "one.csv")


def test_factors_between_units() -> None:
    assert factor("deg", "rad") == pytest.approx(np.pi / 180)
    assert factor("rpm", "rad/s") == pytest.approx(2 * np.pi / 60)
    assert factor("Nm", "N m") == factor("N*m", "N m") == factor("N.m", "N m") == 1.0
    assert factor("mNm", "N m") == factor("ms", "s") == factor("msec", "s") == 1e-3
    assert factor("rad/sec", "rad/s") == factor("seconds", "s") == 1.0
    assert factor("anything", "anything") == 1.0
    with pytest.raises(ValueError, match=r"cannot be in deg; rad/s is wanted, from rad/s, mrad/s, deg/s"):
        factor("deg", "rad/s")


def test_units_are_converted(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    """From the header, or from the columns' names in the config."""
    table = frame(rollout)
    table["time"] *= 1000
    table["pos1"] = np.degrees(table["pos1"])
    table["vel2"] *= 60 / (2 * np.pi)
    table = table.rename(columns={"time": "time [ms]", "pos1": "pos1 (deg)"})
    found = read(study, table, tmp_path, vel2="vel2 [rpm]")
    (piece,) = found.pieces
    assert found.notes == ()
    np.testing.assert_allclose(piece.states, rollout.states[:-1], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(piece.inputs, rollout.inputs[:-1], rtol=1e-9)


def test_comments_stand_above_the_names(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    """As loggers write them; errors keep the file's rows. Names behind a # above numbers are names."""
    text = frame(rollout)[:3].to_csv(index=False)
    file, names = tmp_path / "one.csv", {name: name for name in NAMES}
    file.write_text(f'# rig 3, it\'s "old";\n#\n\n{text}')
    np.testing.assert_array_equal(Reader(study.task, names).read(file).pieces[0].states, rollout.states[:3])
    file.write_text(f"# rig 3\n{text}1.0,2.0\n")
    with pytest.raises(HardwareError, match="row 6: expected 7 cells as in row 2, got 2"):
        Reader(study.task, names).read(file)
    file.write_text(f"#{text}")
    assert Reader(study.task, names | {"time": "#time"}).read(file).pieces[0].frames == 2
    file.write_text(text.replace(",", "\t") + "1.0\t2.0")  # columns separated by tabs; cut off
    found = Reader(study.task, names).read(file)
    assert found.pieces[0].frames == 2
    assert "row 5, the last one, may be cut off and is left out" in found.notes


def test_a_last_line_without_an_end_may_hold_half_a_number(
    study: Study, rollout: Rollout, tmp_path: Path
) -> None:
    """Of whole lines alone, it is left out; a trial keeps it, as files may end so."""
    file = tmp_path / "one.csv"
    file.write_text(frame(rollout)[:4].to_csv(index=False)[:-3])
    reader = Reader(study.task, {name: name for name in NAMES})
    kept, left = (reader.read(file, whole_lines) for whole_lines in (False, True))
    assert (kept.pieces[0].frames, left.pieces[0].frames) == (3, 2)
    assert "row 5, the last one, may be cut off and is left out" in left.notes


def test_rates_of_their_own_and_jitter(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    """Positions at times that jitter are linear between them. Torques in every fourth line are held."""
    table, rng = frame(rollout), np.random.default_rng(0)
    jittered = table["time"] + rng.uniform(-4e-4, 4e-4, len(table))
    jittered.iloc[0] = 0.0
    for name in NAMES[1:]:
        table[name] = np.interp(jittered, table["time"], table[name])
    table["time"] = jittered
    rare = np.arange(len(table)) % 4 > 0
    table["tau1"] = table["tau1"].where(~rare)  # blank
    table["tau2"] = table["tau2"].astype(object).where(~rare, "NA")
    (piece,) = read(study, table, tmp_path).pieces
    k = piece.frames
    assert 990 < k <= 999
    np.testing.assert_allclose(piece.states, rollout.states[: k + 1], atol=2e-2)
    held = rollout.inputs[np.arange(k) // 4 * 4]
    assert np.quantile(np.abs(piece.inputs - held), 0.9) < 1e-2


@pytest.mark.parametrize("rows", [1, 3, 7])
@pytest.mark.parametrize("frames", [1, 2, 5])
def test_inputs_are_held_and_a_frame_has_their_mean(
    study: Study, rows: int, frames: int, tmp_path: Path
) -> None:
    """Commands every few rows; rows a part of a frame apart, nearly at the frames' times."""
    rng = np.random.default_rng(0)
    t, commands = 0.002 / frames * np.arange(241), rng.standard_normal((241, 2))
    table = pd.DataFrame(np.column_stack([t, np.sin(t)[:, None] * [1, 1], np.cos(t), np.cos(t), commands]))
    table.columns = NAMES
    table.loc[np.arange(241) % rows > 0, ["tau1", "tau2"]] = np.nan
    table.loc[1:239, "time"] += 0.005 * 0.002 * rng.uniform(-1, 1, 239)
    (piece,) = read(study, table, tmp_path).pieces
    held = commands[np.arange(240) // rows * rows].reshape(-1, frames, 2)
    np.testing.assert_allclose(piece.inputs, held.mean(axis=1), atol=0.03)
    if frames == 1:
        np.testing.assert_array_equal(piece.inputs, held[:, 0])


def test_gaps_and_resets_cut_it(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    table = frame(rollout)
    gap = table.drop(index=range(300, 350))
    found = read(study, gap, tmp_path)
    assert [piece.frames for piece in found.pieces] == [299, 649]
    assert found.notes == ("gaps or resets leave 2 pieces: 0.60 s, 1.30 s",)
    np.testing.assert_allclose(found.pieces[1].states[0], rollout.states[350], rtol=1e-9)
    table.loc[400:, "time"] -= table.loc[400, "time"]
    found = read(study, table, tmp_path)
    assert [piece.frames for piece in found.pieces] == [399, 599]
    np.testing.assert_allclose(found.pieces[1].states, rollout.states[400:-1], atol=1e-9)
    study = pendulum(f"hardware.folder={tmp_path}", "hardware.columns=null")
    with pytest.raises(HardwareError, match=r"one\.csv: its times have a gap or a reset"):
        study.hardware.rollout("one.csv")  # type: ignore[attr-defined]


def test_what_is_left_out_at_either_end_is_told(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    """With the column that lacks. Three rows, and a column of a rate of its own, are as usual."""
    table = frame(rollout)
    cases: list[tuple[list[str], slice, tuple[str, ...], int]] = [
        (["tau1", "tau2"], slice(0, 499), ("the first 1 s lack tau1, tau2, and are left out",), 499),
        (["pos2", "vel2"], slice(250, None), ("the last 1.5 s lack pos2, vel2, and are left out",), 249),
        (["pos1"], slice(0, 2), (), 996),
        (["tau1"], slice(997, None), (), 997),
    ]
    for names, rows, notes, frames in cases:
        cut = table.copy()
        cut.loc[rows, names] = np.nan
        found = read(study, cut, tmp_path)
        assert (found.notes, [piece.frames for piece in found.pieces]) == (notes, [frames])
    rare = table.assign(tau1=table["tau1"].where(table.index % 20 == 19))
    assert read(study, rare, tmp_path).notes == ()


def test_rows_of_one_time_are_told(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    """As where a log rounds it; not a single one, nor rows of several rates."""
    table = frame(rollout)
    found = read(study, table.assign(time=np.floor(table["time"] * 100 + 1e-6) / 100), tmp_path)
    told = "800 of 1000 samples have the time of the one before; the first of each counts"
    assert told in found.notes
    assert read(study, pd.concat([table[:1], table]), tmp_path).notes == ()
    inputs = ["tau1", "tau2"]
    apart = pd.concat([table.drop(columns=inputs), table[["time", *inputs]]])
    assert read(study, apart.sort_values("time", kind="stable"), tmp_path).notes == ()


def test_without_a_frame_that_all_columns_hold_it_is_refused(
    study: Study, rollout: Rollout, tmp_path: Path
) -> None:
    """Torques by another clock: what is between is invented. And what is shorter than a frame."""
    table = frame(rollout)
    later = table[["time", "tau1", "tau2"]].assign(time=table["time"] + 1000)
    for columns in (["tau1", "tau2"], ["tau2"], ["tau1"]):
        apart = pd.concat([table.drop(columns=columns), later[["time", *columns]]])
        with pytest.raises(HardwareError, match=r"one\.csv: its columns have no frame in common"):
            read(study, apart, tmp_path)
    with pytest.raises(HardwareError, match=r"one\.csv: expected a frame of 0\.002 s at least, got 0\.001 s"):
        read(study, table[:2].assign(time=[0.0, 0.001]), tmp_path)
    with pytest.raises(HardwareError, match=r"one\.csv: expected a frame of 0\.002 s at least, got 0\.001 s"):
        read(study, table[:4].assign(time=[0.0, 0.001, 1.0, 1.001]), tmp_path)
    for rows, words in (
        ([2, 1, 0], r"row 3, column time: expected times that increase, got 0\.002 after 0\.004"),
        ([0, 3, 1, 4, 2], r"row 4, column time: expected times that increase, got 0\.002 after 0\.006"),
    ):
        with pytest.raises(HardwareError, match=words):
            read(study, table.iloc[rows], tmp_path)


def test_wrapped_angles_are_unwound(study: Study, tmp_path: Path) -> None:
    """A joint that turns all the time."""
    t = 0.002 * np.arange(1000)
    states = np.stack([20 * t, 0 * t, np.full(1000, 20.0), 0 * t], axis=1)
    table = pd.DataFrame(np.column_stack([t, states, np.zeros((1000, 2))]), columns=NAMES)
    table["pos1"] = np.angle(np.exp(1j * table["pos1"]))
    found = read(study, table, tmp_path)
    np.testing.assert_allclose(found.pieces[0].states[:, 0], states[:, 0], atol=1e-9)
    assert "pos1 was wrapped" in found.notes
    later = table.assign(
        time=t + 9.0 * (t >= 1.0), pos1=np.where(t < 1.0, 4 * t, -t), vel1=np.where(t < 1.0, 4.0, -1.0)
    )
    pieces = read(study, later, tmp_path).pieces  # not across a gap
    np.testing.assert_allclose(pieces[1].states[:, 0], -t[500:], atol=1e-9)
    assert "pos2 never changes, so nothing is learned of what it moves" in found.notes
    assert "tau1 never changes, so nothing is learned of what it moves" in found.notes


def test_degrees_are_unwound_by_their_own_turn(study: Study, tmp_path: Path) -> None:
    task = copy(study.task)
    task.states = tuple(each._replace(unit=each.unit.replace("rad", "deg")) for each in task.states)
    t = 0.002 * np.arange(1000)
    table = pd.DataFrame(
        np.column_stack([t, 500 * t, 0 * t, 0 * t + 500, 0 * t, 0 * t, 0 * t]), columns=NAMES
    )
    found = read(replace(study, task=task), table.assign(pos1=table["pos1"] % 360), tmp_path)
    assert "pos1 was wrapped" in found.notes
    np.testing.assert_allclose(found.pieces[0].states[:, 0], 500 * t, atol=1e-9)


def test_a_velocity_that_lacks_is_estimated_and_said_so(
    study: Study, rollout: Rollout, tmp_path: Path
) -> None:
    found = read(study, frame(rollout).drop(columns="vel2"), tmp_path)
    assert found.notes == ("vel2 is estimated from pos2",)
    inner = slice(10, -10)
    error = found.pieces[0].states[inner, 3] - rollout.states[:-1][inner, 3]
    assert np.sqrt(np.mean(error**2)) < 0.01 * np.std(rollout.states[:, 3])
    mistyped = read(study, frame(rollout), tmp_path, vel2="vle2")
    assert mistyped.notes == ("vel2 is estimated from pos2, as there is no column 'vle2'",)


def test_a_late_velocity_is_told(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    """By five frames of 2 ms; noise of a tenth alone is not, and a piece of 30 ms tells nothing."""
    table, rng = frame(rollout), np.random.default_rng(0)
    for name in "vel1", "vel2":
        table[name] += 0.1 * table[name].std() * rng.standard_normal(len(table))
    assert read(study, table, tmp_path).notes == ()
    short = read(study, table.drop(index=[*range(200, 300), *range(316, 400)]), tmp_path)
    assert short.notes == ("gaps or resets leave 3 pieces: 0.40 s, 0.03 s, 1.20 s",)
    late = read(study, table.assign(vel2=table["vel2"].shift(5)), tmp_path)
    assert late.notes == ("vel2 follows pos2 by 10 ms; without its column, it is estimated",)


def test_another_column_in_place_of_a_velocity_is_refused(
    study: Study, rollout: Rollout, tmp_path: Path
) -> None:
    """Not one that is late, nor noise around rest."""
    table = frame(rollout)
    swapped = table.assign(pos1=table["vel1"], vel1=table["pos1"])
    with one_line(r"one\.csv: pos1 does not change as vel1 says: is it another column\?", HardwareError):
        read(study, swapped, tmp_path)
    late = read(study, table.assign(vel1=table["vel1"].shift(40, fill_value=0.0)), tmp_path)
    assert late.notes == ("vel1 follows pos1 by 80 ms; without its column, it is estimated",)
    rest = np.random.default_rng(0).standard_normal((2, len(table)))
    assert read(study, table.assign(pos1=1e-3 * rest[0], vel1=0.1 * rest[1]), tmp_path).pieces


@pytest.mark.slow
def test_what_cannot_be_meant_so_is_one_line(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    cases: list[tuple[dict[str, float], dict[str, str], str]] = [
        ({"pos1": 180 / np.pi}, {}, r"pos1 changes 57\.3 times as fast as vel1 says: is a unit wrong"),
        ({"time": 10}, {}, r"pos1 changes 0\.1 times as fast as vel1 says"),
        ({}, {"pos1": "pos_1"}, r"row 1: expected a column pos_1, got none; did you mean pos1\?"),
        ({}, {"pos1": "pos1 [kg]"}, r"pos1: cannot be in kg; rad is wanted, from rad, mrad, deg"),
        ({}, {"time": "time [kg]"}, r"one\.csv: time: cannot be in kg; s is wanted"),
        ({"time": 1e9}, {}, r"one\.csv: .* every 2e\+06 s: is it another unit of time\?"),  # nanoseconds
    ]
    for change, columns, words in cases:
        table = frame(rollout)
        for name, scale in change.items():
            table[name] *= scale
        with one_line(words, HardwareError) as error:
            read(study, table, tmp_path, **columns)
        assert "one.csv" in str(error.value)
    assert read(study, table, tmp_path, time="time [ns]").pieces
    outlier = frame(rollout)
    outlier.loc[100, "pos1"] = 1e6
    with one_line(
        r"one\.csv: column pos1 jumps by 1e\+06 rad from 0\.198 s to 0\.2 s, more than a turn", HardwareError
    ):
        read(study, outlier, tmp_path)
    rare = frame(rollout).drop(columns=["vel1", "vel2"]).assign(time=0.1 * np.arange(1000))
    assert read(study, rare.rename(columns={"time": "time [s]"}), tmp_path).pieces
    assert read(study, rare, tmp_path, time="time [s]").pieces
    rare["tau1"] = [0.5, *[np.nan] * 999]
    with one_line(r"one\.csv: column tau1: expected two samples at least, got 1", HardwareError):
        read(study, rare, tmp_path)
    with one_line(
        r"every 2 s: is it another unit of time\?", HardwareError
    ):  # ms, without a velocity to tell
        read(
            study, frame(rollout).drop(columns=["vel1", "vel2"]).assign(time=2.0 * np.arange(1000)), tmp_path
        )


def test_inputs_beyond_their_limits_are_told_or_refused(
    study: Study, rollout: Rollout, tmp_path: Path
) -> None:
    """A little: a note. By far, as mN m that no unit tells: one line."""
    table = frame(rollout)
    scale = study.task.input_limit[0] / table["tau1"].abs().max()
    assert not any("limited" in note for note in read(study, table, tmp_path).notes)
    found = read(study, table.assign(tau1=1.2 * scale * table["tau1"]), tmp_path)
    said = r"up to \S+ N m, the mean over a frame, of tau1, which is limited to \S+ N m"
    assert any(re.fullmatch(said, note) for note in found.notes)
    with one_line(r"one\.csv: column I1: got \S+ N m of tau1, which is limited to", HardwareError):
        read(study, table.assign(I1=1e3 * table["tau1"]).drop(columns="tau1"), tmp_path, tau1="I1")


def test_a_column_is_of_one_quantity_and_one_column(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    twice = frame(rollout)[:9].rename(columns={"tau2": "tau1"})
    for name in "tau1", "tau1 [N m]":
        with pytest.raises(HardwareError, match=r"one\.csv: row 1: several columns are named tau1"):
            read(study, twice.rename(columns={"tau1": name}), tmp_path, tau2="vel2")
    table = frame(rollout)[:9].rename(columns={"pos1": "pos1 [rad]"})
    table["pos1 [deg]"] = np.degrees(2.0 * table["pos1 [rad]"])
    (piece,) = read(study, table, tmp_path, pos1="pos1 [deg]").pieces  # the one that is named whole
    np.testing.assert_allclose(piece.states[:, 0], 2.0 * table["pos1 [rad]"], rtol=1e-9)
    with pytest.raises(HardwareError, match=r"one\.csv: row 1: several columns are named pos1"):
        read(study, table, tmp_path)
    with pytest.raises(ValueError, match="columns names q for both pos1 and pos2"):
        Recorded(study.task, str(tmp_path), columns={"pos1": "q [deg]", "pos2": "q"})


def bag(rollout: Rollout, folder: Path, plugin: str, ahead: float | None = 0.0, late: int = 500_000) -> Path:
    """Joint states and efforts as ROS 2 has them, efforts on a topic of their own at half the rate.

    The clock of these is some seconds ahead, or they have no time.
    """
    rosbag2, typesys = (pytest.importorskip(f"rosbags.{name}") for name in ("rosbag2", "typesys"))
    store = typesys.get_typestore(typesys.Stores.LATEST)
    state, header = store.types["sensor_msgs/msg/JointState"], store.types["std_msgs/msg/Header"]
    stamp, none = store.types["builtin_interfaces/msg/Time"], np.empty(0)
    names = ["elbow", "shoulder"]
    with rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin[plugin]) as writer:
        joint_states, efforts = (
            writer.add_connection(f"/{name}", state.__msgtype__, typestore=store)
            for name in ("joint_states", "efforts")
        )
        for t, (x, u) in enumerate(zip(rollout.states, rollout.inputs, strict=False)):
            at = 1_000_000_000 + 2_000_000 * t
            head = header(stamp=stamp(sec=at // 10**9, nanosec=at % 10**9), frame_id="")
            joints = state(head, names, x[[1, 0]].copy(), x[[3, 2]].copy(), none)
            of_effort = 0 if ahead is None else at + round(ahead * 10**9)
            other = header(stamp=stamp(sec=of_effort // 10**9, nanosec=of_effort % 10**9), frame_id="")
            sent = [(joint_states, joints), (efforts, state(other, names, none, none, u))]
            for topic, message in sent[: 2 - t % 2]:
                writer.write(topic, at + late, store.serialize_cdr(message, state.__msgtype__))
    return folder


@pytest.mark.slow
def test_ros_bags_and_mcap(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    """A folder of SQLite, and a file of MCAP."""
    columns = {"time": "time", "tau1": "/efforts.effort[0]", "tau2": "/efforts.effort[1]"}
    for i, joint in ((1, "shoulder"), (2, "elbow")):
        columns |= {f"pos{i}": f"/joint_states.position[{joint}]"}
        columns |= {f"vel{i}": f"/joint_states.velocity[{joint}]"}
    (mcap,) = bag(rollout, tmp_path / "mcap", "MCAP").glob("*.mcap")
    for path in (bag(rollout, tmp_path / "sqlite", "SQLITE3"), mcap):
        found = Reader(study.task, columns).read(path)
        (piece,) = found.pieces
        assert (piece.frames, found.notes) == (999, ())
        np.testing.assert_allclose(piece.states, rollout.states[: piece.frames + 1], atol=1e-5)
        for wrong, words in (
            ("/joint_state.position[0]", "expected a column /joint_state, got none; did you"),
            ("/joint_states.position[knee]", "no such number in a message"),
        ):
            with pytest.raises(HardwareError, match=words):
                Reader(study.task, columns | {"pos1": wrong}).read(path)


@pytest.mark.slow
def test_topics_of_two_clocks_are_told(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    """Where headers and arrival are apart by more in one topic, or in one that has headers alone."""
    columns = {"time": "time", "tau1": "/efforts.effort[0]", "tau2": "/efforts.effort[1]"}
    for i in 1, 2:
        columns[f"pos{i}"], columns[f"vel{i}"] = (
            f"/joint_states.{x}[{2 - i}]" for x in ("position", "velocity")
        )
    for ahead, late, told in ((0.5, 0, "0 s, /efforts 0.5 s"), (None, 200_000_000, "-0.2 s, /efforts none")):
        path = bag(rollout, tmp_path / str(late), "MCAP", ahead, late)
        said = f"header times minus arrival times: /joint_states {told}; topics may be misaligned"
        assert said in Reader(study.task, columns).read(path).notes
    arrived = bag(rollout, tmp_path / "arrived", "MCAP", None)
    assert Reader(study.task, columns).read(arrived).notes == ()


def test_a_bag_that_is_none_is_one_line(study: Study, tmp_path: Path) -> None:
    (tmp_path / "one.mcap").write_bytes(b"no bag")
    with pytest.raises(HardwareError, match=r"one\.mcap: cannot be read"):
        Reader(study.task, {name: f"/t.{name}" for name in NAMES}).read(tmp_path / "one.mcap")


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


@pytest.mark.slow
def test_random_experiments_are_the_first_recordings(rollout: Rollout, tmp_path: Path) -> None:
    """The policies' have those behind. Other files than CSV are none."""
    for count in range(3):
        frame(rollout).assign(tau1=count).to_csv(tmp_path / f"{count}.csv", index=False)
    for name in ("0.csv.bak", "1.csvx", "no.csv~"):
        (tmp_path / name).touch()
    options = ["random_experiments=2", "max_iterations=1", "experiments=1"]
    study = pendulum(
        *(f"hardware.folder={tmp_path}", "hardware.columns=null", "policy=output_feedback", "bias=none"),
        *("identification=none", "optimizer.max_evaluations=2", "evaluation=nominal_start"),
        *("method=model_based", *(f"method.{option}" for option in options)),
    )
    assert [path.name for path in study.hardware.source_files] == ["0.csv", "1.csv", "2.csv"]
    made: list[float] = []
    watching = Observer()
    watching.experimented = lambda rollout: made.append(rollout.inputs[0, 0])  # type: ignore[method-assign]
    list(study.run(watching))
    assert made == [0.0, 1.0, 2.0]


def test_between_the_lines_states_are_linear_and_inputs_held(tmp_path: Path) -> None:
    names = "time,pos1,pos2,vel1,vel2,tau1,tau2"
    rows = [[t, t, 2 * t, 3 * t, 4 * t, t / 2, t / 5] for t in (5.0, 5.003, 5.0101)]
    (tmp_path / "line.csv").write_text("\n".join([names, *(",".join(map(str, row)) for row in rows)]))
    study = pendulum(f"hardware.folder={tmp_path}", "hardware.columns=null")
    rollout = study.experiment(np.zeros(study.policy.n_parameters), np.random.default_rng(0))
    assert (rollout.failed_at, rollout.failure) == (5, ENDS)
    at = 5.0 + 0.002 * np.arange(6)
    np.testing.assert_allclose(rollout.states, np.outer(at, [1, 2, 3, 4]), rtol=1e-12)
    held = [5.0, (5.0 + 5.003) / 2, 5.003, 5.003, 5.003]
    np.testing.assert_allclose(rollout.inputs, np.outer(held, [0.5, 0.2]), rtol=1e-12)


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
