"""The bongoboard for any physics engine: its bodies, their initial motion, and which of them touch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from simbias.core.records import Array
from simbias.robots.bongoboard.gaps import NO_GAPS, Gaps
from simbias.robots.bongoboard.task import Bongoboard, Robot

Feet = Literal["plate", "separate", "fixed"]
Place = Sequence[float]  # x, y in m and global angle in rad
Turn = Sequence[float]  # global angle in rad, and its rate

SETTLING_STEPS = 20  # repetitions of the first frame: a solver starts from its last forces
FLOOR_END = 10.0  # m, on either side
ROTORS = "left rotor", "right rotor"  # of the motors, if there is backlash between them and the legs
ROTOR_MASS = 1e-3  # kg; the motors' mass is included in the legs

# Pairs of bodies that touch; legs and pelvis have no shape.
FLOOR, WHEEL, BOARD, FOOT = 1, 2, 4, 8
TOUCHES = {FLOOR: WHEEL | BOARD, WHEEL: FLOOR | BOARD, BOARD: FLOOR | WHEEL | FOOT, FOOT: BOARD}


@dataclass(frozen=True)
class Assembly:
    """The bodies of a bongoboard at the start of an engine; a payload forms one body with the pelvis."""

    task: Bongoboard
    scale: float = 1.0  # of every mass and moment of inertia of the robot
    feet: Feet = "plate"
    overlap: float = 0.0  # m, by which bodies in contact may overlap
    gaps: Gaps = NO_GAPS

    def inertias(self) -> dict[str, tuple[float, float]]:
        """Mass (kg) and moment of inertia about the centre (kg m^2) of every body."""
        robot, gaps = self.task.robot, self.gaps
        leg = _bar(robot.leg_mass, robot.leg_length, 0.0)
        bodies = {
            "wheel": (robot.wheel_mass, robot.wheel_mass * robot.wheel_radius**2 / 2),
            "board": _bar(robot.board_mass, robot.board_length, robot.board_thickness),
            "left leg": leg,
            "right leg": leg,
            "pelvis": (robot.pelvis_mass, robot.pelvis_inertia),
        }
        if self.feet == "separate":
            foot = _bar(robot.foot_mass / 2, robot.foot_length / 2, robot.ankle_height)
            bodies |= {"left foot": foot, "right foot": foot}
        else:
            bodies["foot"] = _bar(robot.foot_mass, robot.foot_length, robot.ankle_height)
        scaled = {name: (self.scale * mass, self.scale * inertia) for name, (mass, inertia) in bodies.items()}
        if gaps.payload_mass:
            mass, inertia = scaled["pelvis"]
            both = mass + gaps.payload_mass
            apart = gaps.payload_x**2 + gaps.payload_y**2
            scaled["pelvis"] = both, inertia + mass * gaps.payload_mass / both * apart
        if gaps.backlash:
            scaled |= dict.fromkeys(ROTORS, (ROTOR_MASS, gaps.rotor_inertia / 2))
        return scaled

    def places(self, angles: Array) -> dict[str, Array]:
        """Centre (x, y) and global angle (3,) of every body, at (alpha_w, alpha_b, theta), real or complex.

        Bodies in contact overlap by half the allowed overlap, so that they touch from the first frame on.
        """
        robot, pose, gaps = self.task.robot, self.task.pose(angles), self.gaps
        phi = pose.board_angle
        spacing = robot.foot_length / 2 if self.feet == "separate" else robot.ankle_spacing
        aside = spacing / 2 * np.array([np.cos(phi), np.sin(phi)])
        foot = pose.ankles - robot.ankle_height / 2 * np.array([-np.sin(phi), np.cos(phi)])
        leg = (pose.ankles + pose.pelvis) / 2
        share = gaps.payload_mass / (gaps.payload_mass + self.scale * robot.pelvis_mass)
        x, y = share * gaps.payload_x, share * gaps.payload_y
        off_centre = np.array([x * np.cos(phi) - y * np.sin(phi), x * np.sin(phi) + y * np.cos(phi)])
        bodies = {  # centre, angle, contacts below
            "wheel": (pose.wheel, pose.wheel_angle, 1),
            "board": (pose.board, phi, 2),
            "foot": (foot, phi, 3),
            "left foot": (foot - aside, phi, 3),
            "right foot": (foot + aside, phi, 3),
            "left leg": (leg - aside, pose.leg_angle, 3),
            "right leg": (leg + aside, pose.leg_angle, 3),
            "pelvis": (pose.pelvis + off_centre, phi, 3),
            "left rotor": (leg - aside, pose.leg_angle, 3),
            "right rotor": (leg + aside, pose.leg_angle, 3),
        }
        return {
            name: np.array([x, y - contacts * self.overlap / 2, angle])
            for name, ((x, y), angle, contacts) in bodies.items()
        }

    def motion(self, start: Array) -> dict[str, tuple[Array, Array]]:
        """Place x, y, angle and velocity of every body, (3,) each, at a start (6,)."""
        h = 1e-30  # complex step: the velocities are exact
        placed = self.places(start[:3] + 1j * h * start[3:])
        return {name: (place.real, place.imag / h) for name, place in placed.items()}


def state_of(wheel: Turn, board: Turn, left: Turn, right: Turn) -> list[float]:
    """The task's state (6,) from the global angles and rates of wheel, board and legs."""
    each = zip(wheel, board, left, right, strict=True)  # angles, then rates
    return [part for w, b, one, other in each for part in (w, b - w, (one + other) / 2 - b)]


def contact(robot: Robot, wheel: Place, board: Place) -> tuple[float, float]:
    """Penetration (m) of the board's lowest corner into the floor, and gap (m) between wheel and board."""
    half_length, half_thickness = robot.board_length / 2, robot.board_thickness / 2
    wheel_x, wheel_y, _ = wheel
    x, y, angle = board
    c, s = math.cos(angle), math.sin(angle)
    depth = half_length * abs(s) + half_thickness * c - y
    along = abs((wheel_x - x) * c + (wheel_y - y) * s)
    across = abs((wheel_y - y) * c - (wheel_x - x) * s)
    distance = math.hypot(max(along - half_length, 0.0), max(across - half_thickness, 0.0))
    return depth, distance - robot.wheel_radius


def _bar(mass: float, length: float, thickness: float) -> tuple[float, float]:
    """Mass and moment of inertia of a solid bar about its centre."""
    return mass, mass * (length**2 + thickness**2) / 12
