"""Recordings as labs have them: units, rates, gaps, what lacks; ROS bags, MCAP; and in place of a robot."""

import gzip
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from errors import one_line
from pendulum import experiment, pendulum
from point_mass import PointMass

import simbias
from simbias.core import HardwareError
from simbias.core.errors import ConfigError
from simbias.core.records import Rollout
from simbias.core.table import read_table
from simbias.lab.clocks import cuts
from simbias.lab.recorded import ENDS, Recorded
from simbias.lab.recording import Reader, Recording
from simbias.lab.units import factor
from simbias.trial.observer import Observer
from simbias.trial.study import Study

Read = Callable[..., Recording]
NAMES = ["time", "pos1", "pos2", "vel1", "vel2", "tau1", "tau2"]


@pytest.fixture(scope="module")
def study() -> Study:
    return pendulum()


@pytest.fixture(scope="module")
def rollout(study: Study) -> Rollout:
    """Two seconds without noise."""
    return experiment(study.nominal, np.random.default_rng(0), 1000, np.zeros(4))


@pytest.fixture
def table(rollout: Rollout) -> pd.DataFrame:
    """It with the task's own names."""
    time = 0.002 * np.arange(rollout.frames)
    return pd.DataFrame(np.column_stack([time, rollout.states[:-1], rollout.inputs]), columns=NAMES)


@pytest.fixture
def read(study: Study, tmp_path: Path) -> Read:
    """Reads a table from a CSV file, or a text; its columns are found by their names, or others."""

    def of(content: pd.DataFrame | str, whole_lines: bool = False, **columns: str) -> Recording:
        file = tmp_path / "one.csv"
        file.write_text(content if isinstance(content, str) else content.to_csv(index=False))
        reader = Reader(study.task, {name: columns.get(name, name) for name in NAMES})
        return reader.read(file, whole_lines)

    return of


def test_factors_between_units() -> None:
    assert factor("deg", "rad") == pytest.approx(np.pi / 180)
    assert factor("rpm", "rad/s") == pytest.approx(2 * np.pi / 60)
    assert factor("Nm", "N m") == factor("N*m", "N m") == factor("N-m", "N m") == 1.0
    assert factor("mNm", "N m") == factor("ms", "s") == factor("msec", "s") == 1e-3
    assert factor("rad/sec", "rad/s") == factor("seconds", "s") == factor("meters", "m") == 1.0
    assert factor("Deg/s", "rad/s") == factor("degrees", "radians") == factor("deg", "rad")
    assert factor("RPM", "rad/s") == factor("rpm", "rad/s")
    assert factor("milliseconds", "s") == factor("millimetres", "m") == 1e-3
    assert factor("microsec", "s") == 1e-6
    assert factor("Nanoseconds", "s") == 1e-9
    assert factor("centimeters", "m") == 1e-2
    assert factor("anything", "anything") == 1.0
    with pytest.raises(ValueError, match=r"cannot be in deg; expected one of rad/s, mrad/s, deg/s"):
        factor("deg", "rad/s")


def test_units_are_converted(read: Read, table: pd.DataFrame, rollout: Rollout) -> None:
    """From the header, or from the columns' names in the config."""
    table["time"] *= 1000
    table["pos1"] = np.degrees(table["pos1"])
    table["vel2"] *= 60 / (2 * np.pi)
    table = table.rename(columns={"time": "time [ms]", "pos1": "pos1 (deg)"})
    found = read(table, vel2="vel2 [rpm]")
    (piece,) = found.pieces
    assert found.notes == ()
    np.testing.assert_allclose(piece.states, rollout.states[:-1], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(piece.inputs, rollout.inputs[:-1], rtol=1e-9)


def test_comments_stand_above_the_names(read: Read, table: pd.DataFrame, rollout: Rollout) -> None:
    """As loggers write them; errors keep the file's rows. Names behind a # above numbers are names."""
    text = table[:3].to_csv(index=False)
    (piece,) = read(f'# rig 3, it\'s "old";\n#\n\n{text}').pieces
    np.testing.assert_array_equal(piece.states, rollout.states[:3])
    with pytest.raises(HardwareError, match="row 6: expected 7 cells as in row 2, got 2"):
        read(f"# rig 3\n{text}1.0,2.0\n")
    assert read(f"#{text}", time="#time").pieces[0].frames == 2
    found = read(text.replace(",", "\t") + "1.0\t2.0")  # columns separated by tabs; cut off
    assert found.pieces[0].frames == 2
    assert "row 5, the last one, may be cut off and is left out" in found.notes


def test_a_last_line_without_an_end_may_hold_half_a_number(read: Read, table: pd.DataFrame) -> None:
    """Of whole lines alone, it is left out; a trial keeps it, as files may end so."""
    kept, left = (read(table[:4].to_csv(index=False)[:-3], whole_lines) for whole_lines in (False, True))
    assert (kept.pieces[0].frames, left.pieces[0].frames) == (3, 2)
    assert "row 5, the last one, may be cut off and is left out" in left.notes


def test_rates_of_their_own_and_jitter(read: Read, table: pd.DataFrame, rollout: Rollout) -> None:
    """Positions at times that jitter are linear between them. Torques in every fourth line are held."""
    rng = np.random.default_rng(0)
    jittered = table["time"] + rng.uniform(-4e-4, 4e-4, len(table))
    jittered.iloc[0] = 0.0
    for name in NAMES[1:]:
        table[name] = np.interp(jittered, table["time"], table[name])
    table["time"] = jittered
    rare = np.arange(len(table)) % 4 > 0
    table["tau1"] = table["tau1"].where(~rare)  # blank
    table["tau2"] = table["tau2"].astype(object).where(~rare, "NA")
    (piece,) = read(table).pieces
    k = piece.frames
    assert 990 < k <= 999
    np.testing.assert_allclose(piece.states, rollout.states[: k + 1], atol=2e-2)
    held = rollout.inputs[np.arange(k) // 4 * 4]
    assert np.quantile(np.abs(piece.inputs - held), 0.9) < 1e-2


@pytest.mark.parametrize("every", [1, 2])
def test_states_that_are_measured_more_rarely_than_frames_are_doubted(
    read: Read, table: pd.DataFrame, every: int
) -> None:
    """Whatever the rate of inputs; the remedy is told."""
    others = np.arange(len(table)) % every > 0
    table["pos2"] = table["pos2"].where(~others)
    recording, doubt = read(table), "states are measured every 0.004 s, in frames of 0.002 s"
    assert recording.doubts == ((doubt,) if every > 1 else ())
    assert recording.notes == ((f"{doubt}: set task.time_step=0.004",) if every > 1 else ())
    table["tau1"] = table["tau1"].where(np.arange(len(table)) % 4 == 0)
    assert read(table).doubts == recording.doubts


@pytest.mark.parametrize("rows", [1, 3, 7])
@pytest.mark.parametrize("frames", [1, 2, 5])
def test_inputs_are_held_and_a_frame_has_their_mean(read: Read, rows: int, frames: int) -> None:
    """Commands every few rows; rows a part of a frame apart, nearly at the frames' times."""
    rng = np.random.default_rng(0)
    t, commands = 0.002 / frames * np.arange(241), rng.standard_normal((241, 2))
    table = pd.DataFrame(np.column_stack([t, np.sin(t)[:, None] * [1, 1], np.cos(t), np.cos(t), commands]))
    table.columns = NAMES
    table.loc[np.arange(241) % rows > 0, ["tau1", "tau2"]] = np.nan
    table.loc[1:239, "time"] += 0.005 * 0.002 * rng.uniform(-1, 1, 239)
    (piece,) = read(table).pieces
    held = commands[np.arange(240) // rows * rows].reshape(-1, frames, 2)
    np.testing.assert_allclose(piece.inputs, held.mean(axis=1), atol=0.03)
    if frames == 1:
        np.testing.assert_array_equal(piece.inputs, held[:, 0])


def test_gaps_and_resets_cut_it(
    read: Read, table: pd.DataFrame, rollout: Rollout, study: Study, tmp_path: Path
) -> None:
    gap = table.drop(index=range(300, 350))
    found = read(gap)
    assert [piece.frames for piece in found.pieces] == [299, 649]
    assert found.notes == ("gaps, resets or jumps leave 2 pieces: 0.60 s, 1.30 s",)
    np.testing.assert_allclose(found.pieces[1].states[0], rollout.states[350], rtol=1e-9)
    held = read(table.assign(tau1=table["tau1"].where(~table.index.isin(range(300, 350)))))
    assert held.notes[0].endswith("leave 2 pieces: 0.60 s, 1.30 s; columns with gaps of their own: tau1")
    table.loc[400:, "time"] -= table.loc[400, "time"]
    found = read(table)
    assert [piece.frames for piece in found.pieces] == [399, 599]
    np.testing.assert_allclose(found.pieces[1].states, rollout.states[400:-1], atol=1e-9)
    bursts = [table[["time", *NAMES[i : i + 2]]].assign(time=table["time"] + 1e-7 * i) for i in (1, 3, 5)]
    apart = pd.concat(bursts).sort_index(kind="stable").drop(columns=["vel1", "vel2"])
    assert [piece.frames for piece in read(apart).pieces] == [398, 598]
    with pytest.raises(HardwareError, match=r"one\.csv: it has a gap, a reset"):
        Recorded(study.task, str(tmp_path)).rollout("one.csv")


def test_rows_that_are_lost_or_doubled_under_a_clock_that_goes_on_cut_it(
    read: Read, table: pd.DataFrame
) -> None:
    """An encoder that turns slowly, and steps now and then, does not, nor does a sample that is late."""
    for kept in (np.r_[:300, 350 : len(table)], np.r_[:300, 200 : len(table)]):
        row = np.arange(len(kept))
        rows = table.iloc[kept].assign(time=0.002 * np.where(row < 100, row, row - 100))  # a reset first
        found = read(rows)
        assert [piece.frames for piece in found.pieces] == [99, 199, len(rows) - 301]
        assert found.notes[0].endswith(
            "a jump at row 302, more than velocities imply: is it reset, or are rows lost?"
        )
        found = read(rows.drop(columns=["vel1", "vel2"]))  # their rates are those of the motion around
        assert "a jump at row 302, more than velocities imply" in "; ".join(found.notes)
        assert [piece.frames for piece in found.pieces] == [99, 199, len(rows) - 301]
    steps = table.iloc[::10].drop(columns=["vel1", "vel2"])  # at 50 Hz, with noise
    noise = 1e-3 * np.random.default_rng(0).standard_normal((2, len(steps)))
    for begins in (0.5, 0.507):
        t = 60.0 * np.maximum(steps["time"] - begins, 0.0)
        servo = steps.assign(pos1=0.5 * (1 - (1 + t) * np.exp(-t)) + noise[0], pos2=noise[1])
        assert len(read(servo).pieces) == 1
    glitches = table.assign(pos1=table["pos1"] + (table.index % 100 == 50))
    assert "row 352, row 353 and 12 other places, more than" in read(glitches).notes[0]
    late = table.assign(time=table["time"].where(table.index != 300, 0.6019))
    assert len(read(late).pieces) == 1
    table["pos1"], table["vel1"] = 0.01 * np.floor(5 * table["time"]), 0.05
    assert len(read(table).pieces) == 1


def test_what_is_left_out_at_either_end_is_told(read: Read, table: pd.DataFrame) -> None:
    """With the column that lacks. Three rows, and a column of a rate of its own, are as usual."""
    cases: list[tuple[list[str], slice, tuple[str, ...], int]] = [
        (["tau1", "tau2"], slice(0, 499), ("the first 1 s lack tau1, tau2, and are left out",), 499),
        (["pos2", "vel2"], slice(250, None), ("the last 1.5 s lack pos2, vel2, and are left out",), 249),
        (["pos1"], slice(0, 2), (), 996),
        (["tau1"], slice(997, None), (), 997),
    ]
    for names, rows, notes, frames in cases:
        cut = table.copy()
        cut.loc[rows, names] = np.nan
        found = read(cut)
        assert (found.notes, [piece.frames for piece in found.pieces]) == (notes, [frames])
    rare = table.assign(tau1=table["tau1"].where(table.index % 20 == 19))
    assert read(rare).notes == ()


def test_rows_of_one_time_are_told(read: Read, table: pd.DataFrame) -> None:
    """As where a log rounds it; not a single one, nor rows of several rates."""
    found = read(table.assign(time=np.floor(table["time"] * 100 + 1e-6) / 100))
    told = "800 of 1000 samples have the same time as the previous one; only the first of each time counts"
    assert told in found.notes
    assert read(pd.concat([table[:1], table])).notes == ()
    inputs = ["tau1", "tau2"]
    apart = pd.concat([table.drop(columns=inputs), table[["time", *inputs]]])
    assert read(apart.sort_values("time", kind="stable")).notes == ()


def test_without_a_frame_that_all_columns_hold_it_is_refused(read: Read, table: pd.DataFrame) -> None:
    """Torques by another clock: what is between is invented. And what is shorter than a frame."""
    later = table[["time", "tau1", "tau2"]].assign(time=table["time"] + 1000)
    for columns in (["tau1", "tau2"], ["tau2"], ["tau1"]):
        apart = pd.concat([table.drop(columns=columns), later[["time", *columns]]])
        with pytest.raises(HardwareError, match=r"one\.csv: its columns have no frame in common"):
            read(apart)
    short = r"one\.csv: expected at least one frame of 0\.002 s, got 0\.001 s"
    for rows, words in (
        (table[:2].assign(time=[0.0, 0.001]), short),
        (table[:4].assign(time=[0.0, 0.001, 1.0, 1.001]), short),
        (table.iloc[[2, 1, 0]], r"row 3, column time: expected times that increase, got 0\.002 after 0\.004"),
        (table.iloc[[0, 3, 1, 4, 2]], r"row 4, column time: expected .*, got 0\.002 after 0\.006"),
    ):
        with pytest.raises(HardwareError, match=words):
            read(rows)


@pytest.mark.parametrize(("unit", "turn"), [("rad", 2 * np.pi), ("deg", 360.0)])
def test_wrapped_angles_are_unwound(
    study: Study, read: Read, unit: str, turn: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A joint that turns all the time, by a turn in its unit."""
    states = tuple(each._replace(unit=each.unit.replace("rad", unit)) for each in study.task.states)
    monkeypatch.setattr(study.task, "states", states)
    t = 0.002 * np.arange(1000)
    angle, rest = 3 * turn * t, 0 * t
    table = pd.DataFrame(
        np.column_stack([t, (angle + turn / 2) % turn - turn / 2, rest, rest + 3 * turn, *3 * [rest]]),
        columns=NAMES,
    )
    found = read(table)
    np.testing.assert_allclose(found.pieces[0].states[:, 0], angle, atol=1e-9)
    assert "pos1 was wrapped, and is unwrapped" in found.notes
    assert "pos2 never changes, so nothing is learned about its motion" in found.notes
    assert "tau1 never changes, so its motor's gain cannot be distinguished from an offset" in found.notes
    rate = np.where(t < 1.0, 4.0, -1.0)
    later = table.assign(time=t + 9.0 * (t >= 1.0), pos1=rate * t, vel1=rate)
    np.testing.assert_allclose(read(later).pieces[1].states[:, 0], -t[500:], atol=1e-9)  # not across a gap


def test_a_velocity_that_lacks_is_estimated_and_said_so(
    read: Read, table: pd.DataFrame, rollout: Rollout
) -> None:
    found = read(table.drop(columns="vel2"))
    assert found.notes == ("vel2 is estimated from pos2",)
    inner = slice(10, -10)
    error = found.pieces[0].states[inner, 3] - rollout.states[:-1][inner, 3]
    assert np.sqrt(np.mean(error**2)) < 0.01 * np.std(rollout.states[:, 3])
    mistyped = read(table, vel2="vle2")
    assert mistyped.notes == ("vel2 is estimated from pos2, as there is no column 'vle2'",)


def test_a_velocity_that_lacks_may_be_the_first_state(tmp_path: Path) -> None:
    task, t = PointMass(), 0.02 * np.arange(100)
    task.states = PointMass.states[::-1]
    pd.DataFrame({"time": t, "position": t**2, "force": 2.0}).to_csv(tmp_path / "one.csv", index=False)
    columns = {name: name for name in ("time", "position", "velocity", "force")}
    recording = Reader(task, columns).read(tmp_path / "one.csv")
    np.testing.assert_allclose(recording.pieces[0].states, np.column_stack([2 * t, t**2]), atol=1e-6)
    np.testing.assert_allclose(recording.times[0], t)


@pytest.mark.parametrize("frame", [0.005, 0.02, 0.05])
def test_estimated_velocities_are_not_damped(frame: float, tmp_path: Path) -> None:
    """Of a swing of 6 rad/s by an encoder of 4096 steps, within 0.3%; in frames of any length."""
    t, step = np.arange(0.0, 6.0, frame), 2 * np.pi / 4096
    swing = {"pos1": step * np.round(0.8 * np.sin(6.0 * t) / step), "pos2": np.sin(3.0 * t)}
    table = pd.DataFrame({"time": t, **swing, "tau1": np.sin(t), "tau2": np.cos(t)})
    table.to_csv(tmp_path / "one.csv", index=False)
    task = pendulum(f"task.time_step={frame}").task
    recording = Reader(task, {name: name for name in NAMES}).read(tmp_path / "one.csv")
    assert bool(recording.doubts) == (frame > 0.01)
    found = recording.pieces[0].states[5:-5, 2]
    true = 4.8 * np.cos(6.0 * t)[5 : len(found) + 5]
    assert found @ true / (true @ true) == pytest.approx(1.0, abs=3e-3)


@pytest.mark.parametrize("every", [0.1, 0.83, 1.0, 1.11, 1.25, 1.67, 1.96, 2.5, 5.0])
def test_noise_in_frames_is_known_from_samples(every: float, tmp_path: Path) -> None:
    """At any rate and phase, and also that of velocities estimated from positions."""
    frame, rng, task = 0.01, np.random.default_rng(0), pendulum("task.time_step=0.01").task
    file, reader = tmp_path / "one.csv", Reader(task, {name: name for name in NAMES})
    for sizes in ({"pos1": 2e-3, "pos2": 5e-3}, {"pos1": 2e-3, "pos2": 5e-3, "vel1": 0.03, "vel2": 0.1}):
        jitter = 0.1 * every * rng.uniform(-1, 1, round(3000 / every))
        t = 0.3 + frame * (every * np.arange(len(jitter)) + jitter)
        swing = {"pos1": np.sin(2 * t), "pos2": np.cos(t), "vel1": 2 * np.cos(2 * t), "vel2": -np.sin(t)}
        clock, pieces = {"time": np.append(0.0, t), "tau1": 0.0, "tau2": 0.0}, []
        for scale in (0.0, 1.0):
            noisy = {
                name: swing[name] + scale * size * rng.standard_normal(len(t)) for name, size in sizes.items()
            }
            table = pd.DataFrame(clock | {name: np.append(np.nan, values) for name, values in noisy.items()})
            table.to_csv(file, index=False)
            pieces += reader.read(file).pieces
        exact, recorded = pieces
        actual = np.std(recorded.states - exact.states, axis=0)
        assert recorded.noise == pytest.approx(actual, rel=0.25)
        assert exact.noise is not None
        assert (exact.noise < 0.2 * actual).all()


def test_a_late_velocity_is_told(read: Read, table: pd.DataFrame) -> None:
    """By five frames of 2 ms; noise of a tenth alone is not, and a piece of 30 ms tells nothing."""
    rng = np.random.default_rng(0)
    for name in "vel1", "vel2":
        table[name] += 0.1 * table[name].std() * rng.standard_normal(len(table))
    assert read(table).notes == ()
    short = read(table.drop(index=[*range(200, 300), *range(316, 400)]))
    assert short.notes == ("gaps, resets or jumps leave 3 pieces: 0.40 s, 0.03 s, 1.20 s",)
    late = read(table.assign(vel2=table["vel2"].shift(5)))
    assert late.notes == ("vel2 lags pos2 by 10 ms; without its column, it is estimated",)
    assert late.doubts == ("velocities lag behind their positions",)


@pytest.mark.parametrize("late", [0.0, 0.2, 0.5])
def test_a_velocity_that_is_late_by_part_of_a_frame_is_told(tmp_path: Path, late: float) -> None:
    """As backward differences of positions are."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 3.0, 0.01)
    swing = {"pos1": np.sin(9.0 * t), "vel1": 9.0 * np.cos(9.0 * (t - 0.01 * late))}
    still = dict.fromkeys(["pos2", "vel2", "tau1", "tau2"], 0.0)
    noisy = {name: values + 0.002 * rng.standard_normal(len(t)) for name, values in (swing | still).items()}
    pd.DataFrame({"time": t} | noisy).to_csv(tmp_path / "one.csv", index=False)
    task = pendulum("task.time_step=0.01").task
    recording = Reader(task, {name: name for name in NAMES}).read(tmp_path / "one.csv")
    assert recording.doubts == (("velocities lag behind their positions",) if late else ())
    told = re.findall(r"vel\d lags pos\d by (\S+) ms", " ".join(recording.notes))
    assert [float(each) for each in told] == ([pytest.approx(10 * late, rel=0.1)] if late else [])


def test_another_column_in_place_of_a_velocity_is_refused(read: Read, table: pd.DataFrame) -> None:
    """Not one that is late, nor noise around rest."""
    swapped = table.assign(pos1=table["vel1"], vel1=table["pos1"])
    with one_line(
        r"one\.csv: pos1 does not change as vel1 implies: is a column or a unit wrong\?", HardwareError
    ):
        read(swapped)
    late = read(table.assign(vel1=table["vel1"].shift(40, fill_value=0.0)))
    assert late.notes == ("vel1 lags pos1 by 80 ms; without its column, it is estimated",)
    rest = np.random.default_rng(0).standard_normal((2, len(table)))
    assert read(table.assign(pos1=1e-3 * rest[0], vel1=0.1 * rest[1])).pieces


@pytest.mark.slow
def test_what_cannot_be_meant_so_is_one_line(read: Read, table: pd.DataFrame) -> None:
    without = table.drop(columns=["vel1", "vel2"])  # a velocity to tell
    in_nanoseconds, rare = table.assign(time=1e9 * table["time"]), without.assign(time=0.1 * table.index)
    cases: list[tuple[pd.DataFrame, dict[str, str], str]] = [
        (
            table.assign(pos1=180 * table["pos1"] / np.pi),
            {},
            r"pos1 changes 57\.3 times .*: is a unit or",
        ),
        (table.assign(time=10 * table["time"]), {}, r"pos1 changes 0\.1 times as fast as vel1 implies"),
        (
            table.rename(columns={"pos1": "POS1"}),
            {},
            r"expected a column pos1, got none; did you mean POS1\?",
        ),
        (table, {"pos1": "pos_1"}, r"row 1: expected a column pos_1, got none; did you mean pos1\?"),
        (table, {"pos1": "pos1 [kg]"}, r"pos1: cannot be in kg; expected one of rad, mrad, deg"),
        (table, {"time": "time [kg]"}, r"one\.csv: time: cannot be in kg; expected one of s"),
        (in_nanoseconds, {}, r"one\.csv: .* every 2e\+06 s: is the time in another unit\?"),
        (
            table.assign(pos1=table["pos1"].where(table.index != 100, 1e6)),
            {},
            r"column pos1 jumps by 1e\+06 rad from row 101 to row 102, more than a turn",
        ),
        (
            without.assign(pos1=4.0 * (without.index % 2)),
            {},
            r"column pos1 jumps by more than half a turn in 100% of its samples: is it in degrees",
        ),
        (
            without.assign(pos1=40.0 * np.sin(without.index / 12.5)),
            {},
            r"jumps by more than half a turn \d+ times, but goes through 12\.\d turns: is it in degrees",
        ),
        (table.assign(pos1=0.5), {}, r"one\.csv: pos1 never changes, but vel1 does: is it stuck\?"),
        (table.assign(time=1.7e9), {}, r"one\.csv: column time: all \d+ times are the same"),
        (rare.assign(tau1=rare["tau1"][:1]), {}, r"column tau1: expected two samples at least, got 1"),
        (without.assign(time=2.0 * table.index), {}, r"every 2 s: is the time in another unit\?"),  # ms
    ]
    for wrong, columns, words in cases:
        with one_line(words, HardwareError) as error:
            read(wrong, **columns)
        assert "one.csv" in str(error.value)
    assert read(in_nanoseconds, time="time [ns]").pieces
    assert read(rare.rename(columns={"time": "time [s]"})).pieces
    assert read(rare, time="time [s]").pieces


def test_inputs_beyond_their_limits_are_told_or_refused(
    study: Study, read: Read, table: pd.DataFrame
) -> None:
    """A little: a note. By far, as mN m that no unit tells: one line."""
    scale = study.task.input_limit[0] / table["tau1"].abs().max()
    assert not any("limited" in note for note in read(table).notes)
    found = read(table.assign(tau1=1.2 * scale * table["tau1"]))
    said = r"tau1 reaches \S+ N m, beyond the limit of \S+ N m \(means over frames\)"
    assert any(re.fullmatch(said, note) for note in found.notes)
    with one_line(r"one\.csv: column I1: tau1 reaches \S+ N m, beyond the limit of", HardwareError):
        read(table.assign(I1=1e3 * table["tau1"]).drop(columns="tau1"), tau1="I1")


def test_a_counted_angle_that_is_reset_once_is_cut_there(read: Read, table: pd.DataFrame) -> None:
    """It goes through more than a turn, so it is not wrapped, but one reset is no sign of degrees."""
    turning = table.assign(pos1=4.0 + table["pos1"] + 8.0 * table["time"], vel1=table["vel1"] + 8.0)
    reset = turning.assign(pos1=np.where(table.index < 200, turning["pos1"], turning["pos1"] - 5.5))
    found = read(reset)
    assert len(found.pieces) > 1 or any("unwrapped" in note for note in found.notes)
    assert sum(piece.frames for piece in found.pieces) > 0.8 * read(turning).pieces[0].frames


def test_a_rotor_that_pulls_is_beyond_its_lower_limit(tmp_path: Path) -> None:
    task = simbias.load(["preset=quadrotor_square"]).task
    columns = {name: name for name in ("time", *(each.name for each in (*task.states, *task.inputs)))}
    rows = pd.DataFrame(0.0, index=range(50), columns=list(columns)).assign(time=0.01 * np.arange(50))
    for pull, said in ((-1.0, ["left reaches -1 N, beyond the limit of 0 N (means over frames)"]), (0.0, [])):
        rows.assign(left=pull).to_csv(tmp_path / "one.csv", index=False)
        notes = Reader(task, columns).read(tmp_path / "one.csv").notes
        assert [note for note in notes if "limit" in note] == said


def test_a_column_is_of_one_quantity_and_one_column(
    study: Study, read: Read, table: pd.DataFrame, tmp_path: Path
) -> None:
    twice = table[:9].rename(columns={"tau2": "tau1"})
    for name in "tau1", "tau1 [N m]":
        with pytest.raises(HardwareError, match=r"one\.csv: row 1: several columns are named tau1"):
            read(twice.rename(columns={"tau1": name}), tau2="vel2")
    table = table[:9].rename(columns={"pos1": "pos1 [rad]"})
    table["pos1 [deg]"] = np.degrees(2.0 * table["pos1 [rad]"])
    (piece,) = read(table, pos1="pos1 [deg]").pieces  # the one that is named whole
    np.testing.assert_allclose(piece.states[:, 0], 2.0 * table["pos1 [rad]"], rtol=1e-9)
    with pytest.raises(HardwareError, match=r"one\.csv: row 1: several columns are named pos1"):
        read(table)
    with pytest.raises(ValueError, match="columns names q for both pos1 and pos2"):
        Recorded(study.task, str(tmp_path), columns={"pos1": "q [deg]", "pos2": "q"})


def bag(
    rollout: Rollout,
    folder: Path,
    plugin: str,
    ahead: float | None = 0.0,
    late: int = 500_000,
    step: float = 0.0,
    gripper: bool = False,
) -> Path:
    """Joint states and efforts as ROS 2 has them, efforts on a topic of their own at half the rate.

    A gripper may share the topic of joint states.
    The clock of these is some seconds ahead, or they have no time. Halfway, all clocks are set by a step.
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
            arrival = 1_000_000_000 + 2_000_000 * t + late
            at = arrival - late + round(step * 10**9) * (2 * t >= rollout.frames)
            head = header(stamp=stamp(sec=at // 10**9, nanosec=at % 10**9), frame_id="")
            joints = state(head, names, x[[1, 0]].copy(), x[[3, 2]].copy(), none)
            of_effort = 0 if ahead is None else at + round(ahead * 10**9)
            other = header(stamp=stamp(sec=of_effort // 10**9, nanosec=of_effort % 10**9), frame_id="")
            sent = [(joint_states, joints), (efforts, state(other, names, none, none, u))][: 2 - t % 2]
            if gripper:
                sent.append((joint_states, state(head, ["gripper"], np.ones(1), none, none)))
            for topic, message in sent:
                writer.write(topic, arrival, store.serialize_cdr(message, state.__msgtype__))
    return folder


TOPICS = {
    "time": "time",
    "pos1": "/joint_states.position[shoulder]",
    "pos2": "/joint_states.position[0]",  # the elbow's
    "vel1": "/joint_states.velocity[shoulder]",
    "vel2": "/joint_states.velocity[0]",
    "tau1": "/efforts.effort[0]",
    "tau2": "/efforts.effort[1]",
}


@pytest.mark.slow
def test_ros_bags_and_mcap(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    """A folder of SQLite, and a file of MCAP; numbers in a message have names or places."""
    rollout = rollout.part(0, 200)
    (mcap,) = bag(rollout, tmp_path / "mcap", "MCAP").glob("*.mcap")
    for path in (bag(rollout, tmp_path / "sqlite", "SQLITE3"), mcap):
        found = Reader(study.task, TOPICS).read(path)
        (piece,) = found.pieces
        assert (piece.frames, found.notes) == (199, ())
        np.testing.assert_allclose(piece.states, rollout.states[:200], atol=1e-5)
        for wrong, words in (
            ("/joint_state.position[0]", "expected a column /joint_state, got none; did you"),
            ("/joint_states.position[knee]", "no such number in a message"),
        ):
            with pytest.raises(HardwareError, match=words):
                Reader(study.task, TOPICS | {"pos1": wrong}).read(path)
    named = {key: topic.replace("s.position[0]", "s.position[elbow]") for key, topic in TOPICS.items()}
    named["vel2"] = "/joint_states.velocity[elbow]"
    (piece,) = Reader(study.task, named).read(bag(rollout, tmp_path / "g", "MCAP", gripper=True)).pieces
    np.testing.assert_allclose(piece.states, rollout.states[:200], atol=1e-5)


@pytest.mark.slow
def test_topics_of_two_clocks_are_told(study: Study, rollout: Rollout, tmp_path: Path) -> None:
    """Where headers and arrival are apart by more in one topic, or in one that has headers alone."""
    rollout = rollout.part(0, 400)
    for ahead, late, told in ((0.5, 0, "0 s, /efforts 0.5 s"), (None, 200_000_000, "-0.2 s, /efforts none")):
        path = bag(rollout, tmp_path / str(late), "MCAP", ahead, late)
        said = f"header times minus arrival times: /joint_states {told}; topics may be misaligned"
        assert said in Reader(study.task, TOPICS).read(path).notes
    arrived = bag(rollout, tmp_path / "arrived", "MCAP", None)
    assert Reader(study.task, TOPICS).read(arrived).notes == ()


@pytest.mark.slow
@pytest.mark.parametrize(("step", "ahead"), [(-0.1003, 0.0), (-0.9, 0.0), (-0.1003, None), (0.3, None)])
def test_a_clock_that_is_set_cuts_all_topics(
    study: Study, rollout: Rollout, tmp_path: Path, step: float, ahead: float | None
) -> None:
    """At the same arrival; a topic without headers stays aligned. As in a file of columns."""
    rollout = rollout.part(0, 400)
    found = Reader(study.task, TOPICS).read(bag(rollout, tmp_path / "set", "MCAP", ahead, 0, step))
    assert "a clock is reset or stepped at 0.4 s: all topics are cut there" in found.notes
    assert "gaps, resets or jumps leave 2 pieces: 0.40 s, 0.40 s" in found.notes
    for piece, begin in zip(found.pieces, (0, 200), strict=True):
        assert piece.frames >= 198
        frames = slice(begin, begin + piece.frames)
        np.testing.assert_allclose(piece.states[:-1], rollout.states[frames], atol=5e-3)
        held = rollout.inputs[np.arange(begin, begin + piece.frames) // 2 * 2]
        np.testing.assert_allclose(piece.inputs, held, atol=5e-3)


def test_an_old_first_message_is_no_clock_that_was_set() -> None:
    """A latched topic repeats its last message at the start."""
    arrivals = 0.01 * np.arange(50)
    old = arrivals - 0.001
    old[0] = -50.0
    assert len(cuts({"/state": arrivals}, {"/state": old})) == 0
    old[25:] += 3.0
    np.testing.assert_allclose(cuts({"/state": arrivals}, {"/state": old}), [[0.25, 0.25]])


def test_a_bag_that_is_none_is_one_line(study: Study, tmp_path: Path) -> None:
    (tmp_path / "one.mcap").write_bytes(b"no bag")
    with pytest.raises(HardwareError, match=r"one\.mcap: cannot be read"):
        Reader(study.task, {name: f"/t.{name}" for name in NAMES}).read(tmp_path / "one.mcap")


def test_experiments_are_the_recordings_in_turn(study: Study) -> None:
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
@pytest.mark.usefixtures("uncompiled")
def test_random_experiments_are_the_first_recordings(table: pd.DataFrame, tmp_path: Path) -> None:
    """The policies' have those behind. Other files than CSV are none."""
    for count in range(3):
        table.assign(tau1=count).to_csv(tmp_path / f"{count}.csv", index=False)
    for name in ("0.csv.bak", "1.csvx", "no.csv~"):
        (tmp_path / name).touch()
    quick = ["optimizer.max_evaluations=2", "evaluation=nominal_start", "task.horizon=50"]
    options = ["random_experiments=2", "max_iterations=1", "experiments=1"]
    study = pendulum(
        *(f"hardware.folder={tmp_path}", "hardware.columns=null", "policy=output_feedback", "bias=none"),
        *("identification=none", "method=model_based", *(f"method.{option}" for option in options), *quick),
    )
    assert [path.name for path in study.hardware.source_files] == ["0.csv", "1.csv", "2.csv"]
    made: list[float] = []
    watching = Observer()
    watching.experimented = lambda rollout: made.append(rollout.inputs[0, 0])  # type: ignore[method-assign]
    list(study.run(watching))
    assert made == [0.0, 1.0, 2.0]


def test_between_the_lines_states_are_linear_and_inputs_held(study: Study, tmp_path: Path) -> None:
    rows = [[t, t, 2 * t, 3 * t, 4 * t, t / 2, t / 5] for t in (5.0, 5.003, 5.0101)]
    pd.DataFrame(rows, columns=NAMES).to_csv(tmp_path / "line.csv", index=False)
    rollout = Recorded(study.task, str(tmp_path)).rollout("line.csv")
    assert (rollout.failed_at, rollout.failure) == (5, ENDS)
    at = 5.0 + 0.002 * np.arange(6)
    np.testing.assert_allclose(rollout.states, np.outer(at, [1, 2, 3, 4]), rtol=1e-12)
    held = [5.0, (5.0 + 5.003) / 2, 5.003, 5.003, 5.003]
    np.testing.assert_allclose(rollout.inputs, np.outer(held, [0.5, 0.2]), rtol=1e-12)


def test_what_cannot_be_read_is_told(study: Study, read: Read, tmp_path: Path) -> None:
    robot = Recorded(study.task, str(tmp_path))
    with pytest.raises(ConfigError, match="no recording"):
        robot.run(study.policy, np.zeros(3), np.zeros(4), np.random.default_rng(0))
    with pytest.raises(HardwareError, match="expected a column pos2"):
        read("time,pos1\n0,1\n")
    with pytest.raises(HardwareError, match=r"one\.csv: row 3, column pos2: expected a finite number"):
        read(f"{','.join(NAMES)}\n0,0,0,0,0,0,0\n0.01,0,1_2,0,0,0,0\n")
    with pytest.raises(ValueError, match="columns names quantities that the task lacks: angle"):
        Recorded(study.task, str(tmp_path), columns={"angle": "q"})


def test_a_small_file_may_not_hold_more_than_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simbias.core.table.LARGEST", 2**20)
    file = tmp_path / "zeros.csv.gz"
    file.write_bytes(gzip.compress(bytes(2**21)))
    assert file.stat().st_size < 2**14
    with pytest.raises(HardwareError, match=r"zeros\.csv\.gz: holds more than 1 MiB"):
        read_table(file)
