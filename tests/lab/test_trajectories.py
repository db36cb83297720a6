"""What a lab sends: brought to the task's frames, or refused in one line with file, row and column."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from point_mass import PointMass

from simbias.core import HardwareError
from simbias.core.records import Array, Rollout
from simbias.lab.requests.trajectory import Recording, frame, header, read, template

TASK = PointMass(horizon=20)
HEADER = "time (s),position (m),velocity (m/s),force (N),failure"
Lines = list[str]


def motion(times: Array) -> tuple[Array, Array]:
    """States on straight lines, inputs that are held in each frame."""
    states = np.stack([0.5 - times, np.full_like(times, -1.0)], axis=1)
    return states, np.floor(times / TASK.time_step + 1e-9)[:, None] % 4


def lines(every: float = TASK.time_step, rows: int | None = None) -> Lines:
    """A file's lines, with a row every so many seconds."""
    count = round(TASK.horizon * TASK.time_step / every) + 1 if rows is None else rows
    times = every * np.arange(count)
    states, inputs = motion(times)
    table = np.column_stack([times, states, inputs])
    return [HEADER, *(",".join(map(repr, row)) + "," for row in table.tolist())]


def written(folder: Path, text: Lines) -> Path:
    path = folder / "trajectory.csv"
    path.write_text("\n".join(text) + "\n")
    return path


def assert_is_motion(rollout: Rollout) -> None:
    states, inputs = motion(TASK.time_step * np.arange(TASK.horizon + 1))
    np.testing.assert_allclose(rollout.states, states, atol=1e-12)
    np.testing.assert_allclose(rollout.inputs, inputs[:-1], atol=1e-9)
    assert (rollout.failed_at, rollout.sensed) == (None, True)


def test_the_template_is_filled_by_what_it_asks_for(tmp_path: Path) -> None:
    assert ",".join(header(TASK)) == HEADER
    assert template(TASK, np.array([0.5, -1.0])) == f"{HEADER}\n0.0,0.5,-1.0,,\n"
    assert_is_motion(read(written(tmp_path, lines()), TASK))


@pytest.mark.parametrize("every", [0.01, 0.005, 0.02 / 3, 0.001])
def test_a_file_with_more_frequent_rows_is_resampled(tmp_path: Path, every: float) -> None:
    assert_is_motion(read(written(tmp_path, lines(every)), TASK))


def swapped(text: Lines) -> Lines:
    order = [3, 0, 5, 1, 2, 4]
    rows = [line.split(",") for line in text]
    extended = [[*row, "battery" if index == 0 else "12.1"] for index, row in enumerate(rows)]
    return [",".join(row[column] for column in order) for row in extended]


def retimed(text: Lines, when: Callable[[int, float], float]) -> Lines:
    """Rows at other times, by their index and time."""
    rows = [line.split(",", 1) for line in text[1:]]
    return [text[0], *(f"{when(index, float(time))!r},{rest}" for index, (time, rest) in enumerate(rows))]


ACCEPTED: dict[str, Callable[[Lines], Lines]] = {
    "columns in another order, and one more": swapped,
    "a byte order mark, spaces and empty lines": lambda text: [
        "\ufeff" + text[0].replace(",", " , "), "", *text[1:], ""
    ],
    "the last input is empty": lambda text: [*text[:-1], ",".join([*text[-1].split(",")[:3], "", ""])],
    "no column of failures": lambda text: [line.rsplit(",", 1)[0] for line in text],
    "the clock began before": lambda text: retimed(text, lambda index, time: time + 1e5),
    "it goes on after the horizon": lambda text: lines(rows=25),
    "a little jitter": lambda text: retimed(text, lambda index, time: time + 1e-3 * (index % 2)),
}  # fmt: skip


@pytest.mark.parametrize("change", ACCEPTED)
def test_what_is_meant_is_taken(tmp_path: Path, change: str) -> None:
    assert_is_motion(read(written(tmp_path, ACCEPTED[change](lines())), TASK))


def cell(row: int, column: int, text: str) -> Callable[[Lines], Lines]:
    """A change of a cell; rows count as in a spreadsheet."""

    def change(given: Lines) -> Lines:
        cells = given[row - 1].split(",")
        cells[column] = text
        return [*given[: row - 1], ",".join(cells), *given[row:]]

    return change


REFUSED: dict[str, tuple[Callable[[Lines], Lines], str]] = {
    "empty": (lambda text: [], "expected a header and rows, got 0 lines"),
    "a header alone": (lambda text: text[:1], "expected a header and rows, got 1 lines"),
    "a column missing": (
        cell(1, 2, "speed (m/s)"),
        "row 1: expected a column velocity (m/s), got none among 'time (s), position (m), speed (m/s), ",
    ),
    "a column twice": (cell(1, 4, "force (N)"), "row 1: expected a column force (N), got several among "),
    "another unit": (
        cell(1, 1, "position (mm)"),
        "row 1, column position: expected the unit (m), got 'mm'; convert the values",
    ),
    "no unit": (cell(1, 0, "time"), "row 1, column time: expected the unit (s), got ''; convert the values"),
    "no number": (cell(7, 1, "0x"), "row 7, column position: expected a number, got '0x'"),
    "an empty cell": (cell(7, 3, ""), "row 7, column force: expected a number, got ''"),
    "NaN": (cell(9, 2, "nan"), "row 9, column velocity: expected a finite number, got 'nan'"),
    "infinity": (cell(9, 2, "-inf"), "row 9, column velocity: expected a finite number, got '-inf'"),
    "time goes backwards": (
        cell(5, 0, "0.01"),
        "row 5, column time: expected more than 0.04 s, as in the row before, got 0.01 s",
    ),
    "time stands still": (
        cell(5, 0, "0.04"),
        "row 5, column time: expected more than 0.04 s, as in the row before, got 0.04 s",
    ),
    "a gap": (
        lambda text: [*text[:8], *text[11:]],
        "row 9, column time: expected no gap, got one of 0.08 s after 0.12 s",
    ),
    "too rare": (
        lambda text: lines(0.04),
        "column time: expected a row at least every 0.02 s (50 Hz), got one every 0.04 s (25 Hz)",
    ),
    "milliseconds": (
        lambda text: retimed(text, lambda index, time: 1e3 * time),
        "column time: expected a row at least every 0.02 s (50 Hz), got one every 20 s (0.05 Hz)",
    ),
    "an input beyond its limit": (cell(6, 3, "5.1"), "row 6, column force: expected at most 5 N, got 5.1"),
    "short": (
        lambda text: text[:12],
        "row 12: expected 20 frames of 0.02 s, the recording ends after 10 without a failure; if the robot "
        "failed, name how in the last row's column failure",
    ),
    "one row": (lambda text: text[:2], "row 2: expected 20 frames of 0.02 s, the recording ends after 0"),
}  # fmt: skip


@pytest.mark.parametrize("change", REFUSED)
def test_what_is_wrong_is_one_line_with_row_and_column(tmp_path: Path, change: str) -> None:
    wrong, message = REFUSED[change]
    path = written(tmp_path, wrong(lines()))
    with pytest.raises(HardwareError) as caught:
        read(path, TASK)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert str(caught.value).isprintable()


def test_what_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.csv"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(HardwareError, match="cannot be read"):
        read(path, TASK)


def test_a_failure_is_that_of_the_first_state_beyond_a_limit(tmp_path: Path) -> None:
    rollout = read(written(tmp_path, cell(8, 1, "-1.5")(lines())), TASK)
    assert (rollout.failed_at, rollout.failure, rollout.frames, len(rollout.states)) == (6, "distance", 6, 7)


def test_a_failure_may_be_named(tmp_path: Path) -> None:
    rollout = read(written(tmp_path, cell(12, 4, "the cable broke")(lines())[:12]), TASK)
    assert (rollout.failed_at, rollout.failure) == (10, "the cable broke")


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.floats(0.002, 0.02), min_size=25, max_size=200), st.integers(0, 2**32 - 1))
def test_resampling_keeps_the_integral_of_inputs_and_lines_of_states(steps: list[float], seed: int) -> None:
    """Whatever the times: a straight line stays one, and the mean input of all frames is that of all rows."""
    times = np.concatenate([[0.0], np.cumsum(steps)])
    if times[-1] < TASK.horizon * TASK.time_step:
        times = np.concatenate([times, np.arange(times[-1] + 0.02, 0.42, 0.02)])
    states, _ = motion(times)
    inputs = np.random.default_rng(seed).uniform(-5, 5, (len(times), 1))
    rollout = frame(Recording(times, states, inputs), TASK, "here")
    expected, _ = motion(TASK.time_step * np.arange(TASK.horizon + 1))
    np.testing.assert_allclose(rollout.states, expected, atol=0.26 * TASK.time_step)
    end = TASK.horizon * TASK.time_step
    held = np.diff(np.clip(times, 0, end))
    exact = np.sum(held * inputs[:-1, 0])
    jitter = 0.26 * TASK.time_step * 10  # rows on time to a quarter of a frame are taken as they are
    assert abs(TASK.time_step * rollout.inputs.sum() - exact) <= jitter + 1e-9
