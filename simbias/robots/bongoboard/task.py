"""Balancing on a bongoboard (Section VI-A): geometry, parameters, outputs and failure.

Planar, SI units, counter-clockwise positive, floor at y = 0. The wheel rolls on the floor, the board on the
wheel; the robot's legs turn together on the board (a parallelogram), so its pelvis stays parallel to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from simbias.core import Criterion, Quantity, Task
from simbias.core.ranges import (
    Acceleration,
    Angle,
    Coordinate,
    Force,
    Frames,
    Inertia,
    Length,
    Mass,
    NonNegative,
    Positive,
    Rate,
    TimeStep,
)
from simbias.core.records import Array
from simbias.simulation.compiler import elementwise, sincos

SixNumbers = Annotated[list[Coordinate], Field(min_length=6, max_length=6)]


@dataclass(frozen=True)
class Robot:
    """Physical parameters of wheel, board and robot."""

    wheel_radius: Length  # r, m
    wheel_mass: Mass  # kg; a solid disc
    board_length: Length  # m
    board_thickness: Length  # m
    board_mass: Mass  # kg; a solid bar
    ankle_height: Length  # h_a, m above the board's upper side
    foot_length: Length  # m
    foot_mass: Mass  # kg, all feet together
    leg_length: Length  # l, m
    leg_mass: Mass  # kg, of each leg; a thin rod
    pelvis_mass: Mass  # kg, with the upper body
    pelvis_inertia: Inertia  # kg m^2 about its centre
    ankle_spacing: Length  # m between the two ankles
    gravity: Acceleration  # m/s^2
    friction: Positive  # of every contact


@dataclass(frozen=True)
class Start:
    """The start of a run; the deviation applies to each state in hardware experiments."""

    mean: SixNumbers
    deviation: NonNegative


@dataclass(frozen=True)
class Limits:
    """Limits of the failure criteria 3-6 of Section IV-C."""

    distance: Angle  # rad, norm of the three angles
    body_angle: Angle  # rad, global angle of the legs
    board_angle: Angle  # rad, global angle of the board
    speed: Rate  # rad/s, norm of the three rates


class Pose(NamedTuple):
    """Positions of the bodies: points (x, y) in m and global angles in rad."""

    wheel: Array
    board: Array
    ankles: Array  # midpoint of the two ankles
    pelvis: Array
    wheel_angle: float
    board_angle: float  # phi, also that of foot and pelvis
    leg_angle: float


def _contacts(x, lengths):
    """Measures of criteria 1 and 2 of Section IV-C, by geometry."""
    wheel_radius, board_length, board_thickness = lengths
    alpha_b, phi = x[1], x[0] + x[1]
    s, c = sincos(phi)
    centre_height = wheel_radius + (wheel_radius + board_thickness / 2) * c + wheel_radius * alpha_b * s
    lowest_corner = centre_height - board_length / 2 * abs(s) - board_thickness / 2 * abs(c)
    return -lowest_corner, abs(wheel_radius * alpha_b) - board_length / 2


def deviations(x):
    """Measures of criteria 3-6: distance from the static equilibrium, and speed."""
    alpha_w, alpha_b, theta, d_alpha_w, d_alpha_b, d_theta = x
    phi = alpha_w + alpha_b
    return (
        np.sqrt(alpha_w * alpha_w + alpha_b * alpha_b + theta * theta),
        abs(phi + theta),
        abs(phi),
        np.sqrt(d_alpha_w * d_alpha_w + d_alpha_b * d_alpha_b + d_theta * d_theta),
    )


def _measure(x, lengths):
    """Measures of criteria 1-6."""
    return _contacts(x, lengths) + deviations(x)


def _output(x, lengths):
    """Outputs z of Fig. 3(b): horizontal position and velocity of pelvis and ankle, and the foot's angle."""
    r, height, leg_length = lengths  # height: from wheel's centre to ankles
    alpha_w, alpha_b, theta, d_alpha_w, d_alpha_b, d_theta = x
    phi, d_phi = alpha_w + alpha_b, d_alpha_w + d_alpha_b
    s, c = sincos(phi)
    sin_theta, cos_theta = sincos(theta)
    sin_leg, cos_leg = s * cos_theta + c * sin_theta, c * cos_theta - s * sin_theta
    x_p = -r * alpha_w - height * s + r * alpha_b * c - leg_length * sin_leg
    d_x_p = (
        -r * d_alpha_w
        - height * c * d_phi
        + r * d_alpha_b * c
        - r * alpha_b * s * d_phi
        - leg_length * cos_leg * (d_phi + d_theta)
    )
    return x_p, d_x_p, theta, d_theta, phi


class Bongoboard(Task):
    """Balance for `horizon` frames of `time_step` seconds with an ankle torque within `input_limit` N m.

    Policies feed back all states, or the outputs of Fig. 3(b), which lack the board's angular velocity.
    """

    states = (
        Quantity("alpha_w", "rad", "angle"),
        Quantity("alpha_b", "rad", "angle"),
        Quantity("theta", "rad", "angle"),
        Quantity("d_alpha_w", "rad/s", "velocity"),
        Quantity("d_alpha_b", "rad/s", "velocity"),
        Quantity("d_theta", "rad/s", "velocity"),
    )
    inputs = (Quantity("torque", "N m", "torque"),)
    outputs: tuple[Quantity, ...] = (
        Quantity("x_p", "m"),
        Quantity("d_x_p", "m/s"),
        Quantity("theta", "rad"),
        Quantity("d_theta", "rad/s"),
        Quantity("alpha_f", "rad"),
    )

    def __init__(
        self,
        robot: Robot,
        limits: Limits,
        start: Start,
        time_step: TimeStep = 0.001,
        horizon: Frames = 5000,
        input_limit: Force = 100.0,
        outputs: Literal["pelvis", "states"] = "pelvis",
    ) -> None:
        self.robot = robot
        self.limits = limits
        self.time_step = time_step
        self.horizon = horizon
        self.input_limit = np.array([input_limit])
        self.start_mean = np.array(start.mean, dtype=np.float64)
        self.start_deviation = np.full(6, start.deviation)
        r, thickness = robot.wheel_radius, robot.board_thickness
        angles, rates = (
            dict.fromkeys((state.name for state in self.states if state.kind == kind), limit)
            for kind, limit in (("angle", limits.distance), ("velocity", limits.speed))
        )
        off_the_end = {"alpha_b": 0.5 * robot.board_length / r}
        self.criteria = (
            Criterion("board_touches_ground", "the board touches the ground", 0.0, "m"),
            Criterion("board_leaves_wheel", "the board leaves the wheel", 0.0, "m", off_the_end),
            Criterion("distance", "too far from the static equilibrium", limits.distance, "rad", angles),
            Criterion("body_angle", "the body leans too far", limits.body_angle, "rad"),
            Criterion("board_angle", "the board leans too far", limits.board_angle, "rad"),
            Criterion("speed", "too fast", limits.speed, "rad/s", rates),
        )
        height = r + thickness + robot.ankle_height
        self._lengths = {
            _measure: np.array([r, robot.board_length, thickness]),
            _output: np.array([r, height, robot.leg_length]),
        }
        if outputs == "states":
            self.outputs = self.states

    def measure(self, x: Array) -> Array:
        """Measures (..., 6) of criteria 1-6 of Section IV-C at states x (..., 6)."""
        return elementwise(_measure, x, parameters=self._lengths[_measure])

    def output(self, x: Array) -> Array:
        """Outputs z (..., 5) at states x (..., 6) (Fig. 3(b)), or the states themselves."""
        if self.outputs == self.states:
            return x.copy()
        return elementwise(_output, x, parameters=self._lengths[_output])

    def pose(self, angles: Array) -> Pose:
        """Positions and angles of the bodies at (alpha_w, alpha_b, theta), real or complex."""
        alpha_w, alpha_b, theta = angles
        robot, r = self.robot, self.robot.wheel_radius
        phi = alpha_w + alpha_b
        tangent = np.array([np.cos(phi), np.sin(phi)])
        normal = np.array([-np.sin(phi), np.cos(phi)])
        legs = np.array([-np.sin(phi + theta), np.cos(phi + theta)])
        wheel = np.array([-r * alpha_w, r])
        board = wheel + (r + robot.board_thickness / 2) * normal + r * alpha_b * tangent
        ankles = board + (robot.board_thickness / 2 + robot.ankle_height) * normal
        pelvis = ankles + robot.leg_length * legs
        return Pose(wheel, board, ankles, pelvis, alpha_w, phi, phi + theta)
