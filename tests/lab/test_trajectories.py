"""What a lab sends: brought to the task's frames, or refused in one line with file, row and column."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from labs import Pole, lines, requested, written
from point_mass import PointMass

from simbias.core import HardwareError, Quantity
from simbias.core.records import Array, Rollout
from simbias.lab.requests.measurements import Measurements, frame, tell_other_commands
from simbias.lab.requests.trajectory import header, read, template
from simbias.lab.safety import Safety

TASK = PointMass(horizon=20)
REQUEST = requested(TASK, np.array([0.5, -1.0]))
HEADER = "time (s),position (m),velocity (m/s),force (N),failure"
POLE = Pole(horizon=20)
POLE_HEADER = "time (s),angle (rad),rate (rad/s),torque (N m),failure"
TIMES = TASK.time_step * np.arange(TASK.horizon + 1)
Lines = list[str]


def motion(times: Array) -> tuple[Array, Array]:
    """States on straight lines, inputs that are held in each frame."""
    states = np.stack([0.5 - times, np.full_like(times, -1.0)], axis=1)
    return states, np.floor(times / TASK.time_step + 1e-9)[:, None] % 4


def moving(every: float = TASK.time_step, rows: int | None = None) -> Lines:
    """A file's lines, with a row every so many seconds."""
    times = every * np.arange(round(TIMES[-1] / every) + 1 if rows is None else rows)
    return lines(HEADER, np.column_stack([times, *motion(times)]))


def assert_is_motion(rollout: Rollout, why: object) -> None:
    states, inputs = motion(TIMES)
    np.testing.assert_allclose(rollout.states, states, atol=1e-12, err_msg=str(why))
    np.testing.assert_allclose(rollout.inputs, inputs[:-1], atol=1e-9, err_msg=str(why))
    assert (rollout.failed_at, rollout.sensed) == (None, True), why


def refusal(path: Path, request=REQUEST) -> str:
    """What is wrong with a file."""
    with pytest.raises(HardwareError) as caught:
        read(path, request)
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    assert line.isprintable()
    return line.removeprefix(f"{path}: ")


def swapped(text: Lines) -> Lines:
    order = [3, 0, 5, 1, 2, 4]
    rows = [line.split(",") for line in text]
    extended = [[*row, "battery" if index == 0 else "12.1"] for index, row in enumerate(rows)]
    return [",".join(row[column] for column in order) for row in extended]


def retimed(text: Lines, when: Callable[[int, float], float]) -> Lines:
    """Rows at other times, by their index and time."""
    rows = [line.split(",", 1) for line in text[1:]]
    return [text[0], *(f"{when(index, float(time))!r},{rest}" for index, (time, rest) in enumerate(rows))]


def cell(row: int, column: int, text: str) -> Callable[[Lines], Lines]:
    """A change of a cell; rows count as in a spreadsheet."""

    def change(given: Lines) -> Lines:
        cells = given[row - 1].split(",")
        cells[column] = text
        return [*given[: row - 1], ",".join(cells), *given[row:]]

    return change


WORDS = ("nan", "None", "-", "ok")

ACCEPTED: dict[str, Callable[[Lines], Lines]] = {
    "a row every 10 ms": lambda text: moving(0.01),
    "a row every 6.7 ms": lambda text: moving(0.02 / 3),
    "a row every 1 ms": lambda text: moving(0.001),
    "columns in another order, and one more": swapped,
    "a byte order mark, spaces and empty lines": lambda text: [
        "\ufeff" + text[0].replace(",", " , "), "", *text[1:], ""
    ],
    "the last input is empty": lambda text: [*text[:-1], ",".join([*text[-1].split(",")[:3], "", ""])],
    "no column of failures": lambda text: [line.rsplit(",", 1)[0] for line in text],
    "no failure, in words": lambda text: [text[0], *(line + WORDS[i % 4] for i, line in enumerate(text[1:]))],
    "no cells of failures": lambda text: [text[0], *(line.rsplit(",", 1)[0] for line in text[1:])],
    "the clock began before": lambda text: retimed(text, lambda index, time: time + 1e5),
    "it ends after the horizon": lambda text: moving(rows=25),
    "a little jitter": lambda text: retimed(text, lambda index, time: time + 1e-3 * (index % 2)),
    "semicolons": lambda text: [line.replace(",", ";") for line in text],
    "semicolons and decimal commas": lambda text: [
        line.replace(",", ";").replace(".", ",") for line in text
    ],
}  # fmt: skip


def test_what_is_meant_is_taken(tmp_path: Path) -> None:
    assert ",".join(header(TASK)) == HEADER
    assert template(TASK, np.array([0.5, -1.0])) == f"{HEADER}\n0.0,0.5,-1.0,,\n"
    for why, change in ACCEPTED.items():
        assert_is_motion(read(written(tmp_path, change(moving())), REQUEST), why)


REFUSED: dict[str, tuple[Callable[[Lines], Lines], str]] = {
    "empty": (lambda text: [], "expected a header and rows, got 0 lines"),
    "a header alone": (lambda text: text[:1], "expected a header and rows, got 1 lines"),
    "a column missing": (cell(1, 2, "speed (m/s)"), "row 1: expected a column velocity (m/s), got none"),
    "a column twice": (cell(1, 4, "force (N)"), "row 1: expected a column force (N), got several among "),
    "another unit": (cell(1, 1, "position (mm)"), "row 1, column position: expected the unit (m), got 'mm'"),
    "no unit": (cell(1, 0, "time"), "row 1, column time: expected the unit (s), got ''; convert the values"),
    "an empty cell": (cell(7, 3, ""), "row 7, column force: expected a finite number, got ''"),
    "time goes backwards": (cell(5, 0, "0.01"), "row 5, column time: expected more than 0.04 s"),
    "time stands still": (cell(5, 0, "0.04"), "row 5, column time: expected more than 0.04 s"),
    "a gap": (
        lambda text: [*text[:8], *text[11:]],
        "row 9, column time: expected no gap, got one of 0.08 s after 0.12 s",
    ),
    "too rare": (lambda text: moving(0.04), "column time: expected a row at least every 0.02 s (50 Hz)"),
    "milliseconds": (
        lambda text: retimed(text, lambda index, time: 1e3 * time),
        "column time: expected a row at least every 0.02 s (50 Hz), got one every 20 s (0.05 Hz)",
    ),
    "an input beyond its limit": (cell(6, 3, "5.1"), "row 6, column force: expected at most 5 N, got 5.1"),
    "short": (lambda text: text[:12], "row 12: expected 20 frames of 0.02 s, but the recording ends after"),
    "one row": (lambda text: text[:2], "row 2: expected 20 frames of 0.02 s, but the recording ends after 0"),
    "a start elsewhere": (cell(2, 1, "0.1"), "row 2, column position: expected the start 0.5 within 0.2 m"),
    "a start that has failed": (cell(2, 2, "-0.9"), "row 2: expected a start within the limits"),
    "a decimal comma": (cell(7, 3, "1,5"), "row 7: expected 5 cells as in row 1, got 6; is it a decimal "),
    "a decimal comma and no failure": (
        lambda text: cell(7, 3, "1,5")([text[0], *(line[:-1] for line in text[1:])]),
        "row 7, column failure: expected a name, got '5'; has a decimal comma cut a number in two?",
    ),
    "a decimal comma in quotes": (
        lambda text: [*text[:6], text[6].replace("0.4,", '"0,4",'), *text[7:]],
        "row 7, column position: expected a finite number, got '0,4'; is it a decimal comma?",
    ),
    "commas and points": (
        lambda text: [line.replace(",", ";") for line in cell(7, 3, "1")(text)[:7]]
        + [line.replace(",", ";").replace(".", ",") for line in text[7:]],
        "row 2, column time: expected a finite number, got '0.0'",
    ),
    "one comma among points": (
        lambda text: [line.replace(",", ";").replace("1_5", "1,5") for line in cell(7, 3, "1_5")(text)],
        "row 7, column force: expected a finite number, got '1,5'",
    ),
    "a position in degrees": (
        lambda text: lines(HEADER, np.c_[TIMES, 0.5 - 57.3 * TIMES, 0 * TIMES - 1, 0 * TIMES]),
        "position changes 57.3 times as fast as velocity implies: is a unit or a column wrong?",
    ),
    "a failure in between": (cell(7, 4, "fell"), "row 7, column failure: expected it only in the last row"),
}  # fmt: skip


def test_what_is_wrong_is_one_line_with_row_and_column(tmp_path: Path) -> None:
    near = requested(PointMass(horizon=20), np.array([0.95, -1.0]))
    for why, (wrong, message) in REFUSED.items():
        path, request = written(tmp_path, wrong(moving())), REQUEST
        if why == "a start that has failed":
            path, request = written(tmp_path, cell(2, 1, "1.1")(moving())), near
        assert refusal(path, request).startswith(message), why
    path.write_bytes(b"\xff\xfe\x00")
    assert refusal(path).startswith("is not UTF-8 text")


def test_a_sensor_that_stands_still_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    still = requested(TASK, np.array([0.5, 0.0]))
    dead = {"velocity": [0.5 - TIMES, 0 * TIMES], "position": [0 * TIMES + 0.5, 0 * TIMES - 1.0]}
    for name, states in dead.items():
        asked = still if name == "velocity" else REQUEST
        read(written(tmp_path, lines(HEADER, np.c_[TIMES, np.transpose(states), 0 * TIMES])), asked)
        assert f"{name} stands still while" in caplog.text
    read(written(tmp_path, moving()), REQUEST)
    read(written(tmp_path, cell(2, 4, "aborted")(moving()[:2])), REQUEST)  # at the start
    assert caplog.text.count("stands still") == 2


def test_inputs_of_another_experiment_are_told(caplog: pytest.LogCaptureFixture) -> None:
    """Not what noise of the policy's own sensors makes of them, nor a frame that they are late."""
    rng, t = np.random.default_rng(0), 0.02 * np.arange(101)
    states = np.stack([0.5 * np.cos(3 * t), -1.5 * np.sin(3 * t)], axis=1)
    request = requested(PointMass(horizon=100), states[0])
    controller = request.controller()
    inputs = np.array([controller(x) for x in states[:-1]])
    noise = rng.standard_normal(inputs.shape)
    for recorded, is_told in (
        *((inputs, 0), (np.roll(inputs, 1, axis=0), 0), (inputs + np.std(inputs) * noise, 0)),
        *((-0.3 * inputs, 1), (inputs[::-1], 1), (0 * inputs, 1)),
    ):
        caplog.clear()
        tell_other_commands(states, recorded, request, "trajectory.csv")
        assert [each.count("differs from what the requested policy") for each in caplog.messages] == [
            1
        ] * is_told


def test_only_plain_digits_are_numbers(tmp_path: Path) -> None:
    """Python's float() takes some of these."""
    for digits in ("1_2", "\u0661", "\uff11", "0x1", "nan", "-inf", "1e999", "\u22121", "1 2", "1.2.3"):
        message = refusal(written(tmp_path, cell(9, 3, digits)(moving())))
        assert message.startswith("row 9, column force: expected a finite number, got "), digits


@pytest.mark.slow
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    start=st.tuples(st.floats(-0.15, 0.15), st.floats(-0.15, 0.15)),
    seed=st.integers(0, 2**32 - 1),
    row=st.integers(2, TASK.horizon + 2),
    damage=st.sampled_from(["none", "degrees", "degrees from row 3", "decimal comma", "a cell more", "1_2"]),
    style=st.sampled_from([",", ";", "; and decimal commas"]),
)
def test_a_file_is_read_as_it_was_written_or_refused(
    tmp_path: Path, start: tuple[float, float], seed: int, row: int, damage: str, style: str
) -> None:
    """Whatever the numbers: none is taken for another one."""
    rng = np.random.default_rng(seed)
    asked = np.array(start)
    steps = np.concatenate([np.zeros((1, 2)), 5e-5 * rng.standard_normal((POLE.horizon, 2))])
    states = asked + np.cumsum(steps, axis=0)
    line = np.corrcoef(np.arange(len(states)), states[:, 0])[0, 1]
    assume(abs(line) < 0.6)  # else the angle looks like an integral of its rate, in another unit
    inputs = rng.uniform(-5, 5, (POLE.horizon + 1, 1))
    sent = states.copy()
    if damage.startswith("degrees"):
        assume(np.abs(asked).min() > 5e-3)
        sent[int(damage != "degrees") :] *= 180 / np.pi
    text = lines(POLE_HEADER, np.column_stack([TIMES, sent, inputs]))
    if damage == "1_2":
        text = cell(row, 3, "1_2")(text)
    elif damage == "a cell more":
        text[row - 1] += ",1"
    elif damage == "decimal comma":
        text = cell(row, 3, "1,25")(text)
    if style != ",":
        text = [line.replace(",", ";") for line in text]
    if style == "; and decimal commas":
        text = [line.replace(".", ",") for line in text]
    path = written(tmp_path, text)
    if damage == "none":
        rollout = read(path, requested(POLE, asked))
        np.testing.assert_array_equal(rollout.states, states)
        np.testing.assert_array_equal(rollout.inputs, inputs[:-1])
    else:
        message = refusal(path, requested(POLE, asked))
        at = {"degrees": 2, "degrees from row 3": 3}.get(damage, row)
        assert message.startswith(f"row {at}"), message
        assert "degrees" not in damage or "are these degrees?" in message


def test_a_failure_is_that_of_the_first_state_beyond_a_limit(tmp_path: Path) -> None:
    rollout = read(written(tmp_path, cell(8, 1, "-1.5")(moving())), REQUEST)
    assert (rollout.failed_at, rollout.failure, rollout.frames, len(rollout.states)) == (6, "distance", 6, 7)
    rollout = read(written(tmp_path, cell(12, 4, "the cable broke")(moving())[:12]), REQUEST)
    assert (rollout.failed_at, rollout.failure) == (10, "the cable broke")
    every_5_ms = moving(0.005)[:48]  # to 0.23 s, between frames 11 and 12
    for name in ("", "failed"):  # by which controller.h calls any criterion
        rollout = read(written(tmp_path, cell(48, 4, name)(cell(48, 1, "-1.5")(every_5_ms))), REQUEST)
        assert (rollout.failed_at, rollout.failure, len(rollout.states)) == (11, "distance", 12)


def test_what_comes_back_is_held_against_the_safety_limits(tmp_path: Path) -> None:
    """Beyond a state's limit the experiment has ended; an input beyond its own nobody should have sent."""
    limited = requested(TASK, REQUEST.start, Safety(states={"position": 0.5, "velocity": 1.5}))
    assert read(written(tmp_path, moving()), limited).failure is None
    path = written(tmp_path, cell(8, 2, "-1.6")(moving()))
    rollout = read(path, limited)
    assert (rollout.failed_at, rollout.failure, len(rollout.states)) == (6, "unsafe_state_velocity", 7)
    assert read(written(tmp_path, cell(8, 2, "-1.6")(moving())[:8]), limited).failed_at == 6
    weak = requested(TASK, REQUEST.start, Safety(inputs={"force": 2.5}))
    assert refusal(path, weak).startswith("row 5, column force: expected at most 2.5 N, got 3")
    gentle = requested(TASK, REQUEST.start, Safety(input_rates={"force": 140}))
    for every, row in ((TASK.time_step, 6), (0.01, 10)):  # force falls from 3 N to 0 N after 4 frames
        assert refusal(written(tmp_path, moving(every)), gentle).startswith(
            f"row {row}, column force: expected a change by at most 2.8 N in a frame (hardware.safety."
        )
    slow = requested(TASK, REQUEST.start, Safety(states={"velocity": 1.0}))
    assert refusal(written(tmp_path, cell(2, 2, "-1.1")(moving())), slow).startswith(
        "row 2, column velocity: expected at most 1 m/s, got -1.1"
    )


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(0.002, 0.02), min_size=25, max_size=200), st.integers(0, 2**32 - 1))
def test_resampling_keeps_the_integral_of_inputs_and_lines_of_states(steps: list[float], seed: int) -> None:
    """Whatever the times: a straight line stays one, and the mean input of all frames is that of all rows."""
    times = np.concatenate([[0.0], np.cumsum(steps)])
    if times[-1] < TASK.horizon * TASK.time_step:
        times = np.concatenate([times, np.arange(times[-1] + 0.02, 0.42, 0.02)])
    states, _ = motion(times)
    inputs = np.random.default_rng(seed).uniform(-5, 5, (len(times), 1))
    rollout = frame(Measurements(times, states, inputs), REQUEST, "here")
    np.testing.assert_allclose(rollout.states, motion(TIMES)[0], atol=0.26 * TASK.time_step)
    end = TASK.horizon * TASK.time_step
    held = np.diff(np.clip(times, 0, end))
    exact = np.sum(held * inputs[:-1, 0])
    jitter = 0.26 * TASK.time_step * 10  # rows on time to a quarter of a frame are taken as they are
    assert abs(TASK.time_step * rollout.inputs.sum() - exact) <= jitter + 1e-9


class Turning(Pole):
    """Its angle is the same after a turn, and never fails."""

    states = (Quantity("angle", "rad", wraps=True), Quantity("rate", "rad/s"))
    criteria = ()

    def measure(self, x: Array) -> Array:
        return x[..., :0]


def test_angles_that_wrap_are_unwound_before_lines_are_drawn_between_rows() -> None:
    """An encoder within half a turn, asked for a start beyond it."""
    request = requested(Turning(horizon=20), np.array([3.2, 7.3]))
    times = 0.006 * np.arange(68)
    turned = np.column_stack([3.2 + 7.3 * times, np.full(68, 7.3)])
    read_off = np.column_stack([np.angle(np.exp(1j * turned[:, 0])), turned[:, 1]])
    rollout = frame(Measurements(times, read_off, np.zeros((68, 1))), request, "here")
    np.testing.assert_allclose(rollout.states[:, 0], 3.2 + 7.3 * TIMES, atol=1e-12)
    partly = [np.vstack([each[:1], np.degrees(each[1:])]) for each in (turned, read_off)]
    for degrees in (np.degrees(turned), *partly):
        with pytest.raises(HardwareError, match="are these degrees"):
            frame(Measurements(times, degrees, np.zeros((68, 1))), request, "here")


def test_angles_tell_degrees_where_a_robot_is_at_rest() -> None:
    """Its measured rate is noise. Radians after many turns are no degrees, even 57 times the start."""
    rng, degrees = np.random.default_rng(0), 180 / np.pi
    for kind, start, at in ((Turning, 3.2, 3.15), (Turning, 0.11, 0.1), (Pole, 0.06, 0.06)):
        request = requested(kind(horizon=20), np.array([start, 0.04]))
        states = np.array([at, 0.0]) + rng.normal(0, [1e-4, 0.05], (21, 2))
        template = np.array([[start, 0.04]])  # the first row may be simbias's
        turned = [states + np.array([2 * np.pi * n, 0]) for n in range(32)] if kind is Turning else [states]
        for accepted in (*turned, *(np.vstack([template, each[1:]]) for each in turned)):
            assert frame(Measurements(TIMES, accepted, np.zeros((21, 1))), request, "here").failed_at is None
        for refused in (degrees * states, np.vstack([template, degrees * states[1:]])):
            with pytest.raises(HardwareError, match="are these degrees"):
                frame(Measurements(TIMES, refused, np.zeros((21, 1))), request, "here")


def test_the_last_input_is_a_mean_where_rows_end_a_little_early() -> None:
    times = 0.004 * np.arange(100)
    rollout = frame(Measurements(times, motion(times)[0], np.full((100, 1), 3.0)), REQUEST, "here")
    np.testing.assert_allclose(rollout.inputs, np.full((20, 1), 3.0))


def test_what_fails_behind_the_horizon_has_lasted(tmp_path: Path) -> None:
    """A recording may run on, until somebody catches the robot."""
    later, within = moving(rows=len(TIMES) + 5), moving(rows=len(TIMES))
    for text, failed_at in ((later, None), (within, TASK.horizon)):
        named = [*text[:-1], f"{text[-1].removesuffix(',')},caught"]
        assert read(written(tmp_path, named), REQUEST).failed_at == failed_at


def test_nothing_acts_after_the_last_frame(tmp_path: Path) -> None:
    """Its inputs may be blank where zero is none that is allowed."""

    class Pushed(PointMass):
        input_bounds = (np.array([1.0]), np.array([5.0]))

    text = lines(HEADER, np.column_stack([TIMES, motion(TIMES)[0], np.full(len(TIMES), 2.0)]))
    blank = cell(len(text), 3, "")(text)
    rollout = read(written(tmp_path, blank), requested(Pushed(horizon=20), np.array([0.5, -1.0])))
    np.testing.assert_allclose(rollout.inputs, 2.0)
