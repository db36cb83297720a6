"""The bongoboard's geometry: measures and outputs against the pose, which is drawn from the definitions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simbias.core.records import Array
from simbias.trial.study import Study

STATES = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(np.array)


@pytest.mark.slow
@given(STATES)
@settings(deadline=None, max_examples=25)
def test_measures_are_those_of_the_pose(study: Study, x: Array) -> None:
    """The board touches the ground with a corner, and leaves the wheel where the contact passes its end.

    The contact is where the wheel's centre falls on the board's underside.
    """
    robot, pose = study.task.robot, study.task.pose(x[:3])
    tangent = np.array([np.cos(pose.board_angle), np.sin(pose.board_angle)])
    normal = np.array([-tangent[1], tangent[0]])
    along, across = tangent * robot.board_length / 2, normal * robot.board_thickness / 2
    lowest = min((pose.board + i * along + j * across)[1] for i in (-1, 1) for j in (-1, 1))
    measures = study.task.measure(x)
    assert measures[0] == pytest.approx(-lowest, abs=1e-12)
    contact = abs((pose.wheel - pose.board) @ tangent)
    assert measures[1] == pytest.approx(contact - robot.board_length / 2, abs=1e-12)
    gap = (pose.board - pose.wheel) @ normal - robot.wheel_radius - robot.board_thickness / 2
    assert gap == pytest.approx(0.0, abs=1e-12)


@given(STATES)
@settings(deadline=None, max_examples=25)
def test_outputs_are_the_pelvis_the_ankle_and_the_foot(study: Study, x: Array) -> None:
    """Velocities by complex step along the motion."""
    h = 1e-30
    moving = study.task.pose(x[:3] + 1j * h * x[3:])
    expected = [moving.pelvis[0].real, moving.pelvis[0].imag / h, x[2], x[5], moving.board_angle.real]
    np.testing.assert_allclose(study.task.output(x), expected, atol=1e-12)


def test_starts_are_drawn_around_the_mean(study: Study) -> None:
    rng = np.random.default_rng(0)
    starts = np.array([study.task.draw_start(rng) for _ in range(1000)])
    np.testing.assert_allclose(starts.mean(axis=0), [0, 0.05, 0, 0, 0, 0], atol=4 * 0.02 / np.sqrt(1000))
    np.testing.assert_allclose(starts.std(axis=0), 0.02, rtol=4 / np.sqrt(2 * 1000))
