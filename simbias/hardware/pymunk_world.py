"""The bongoboard's bodies, joints and contacts in pymunk.

The engine (Chipmunk) works in maximal coordinates: contacts and joints are impulses, found by iteration. Its
step moves all bodies by their velocities first and then finds the new velocities.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pymunk import (
    Body,
    Circle,
    Constraint,
    PivotJoint,
    Poly,
    RotaryLimitJoint,
    Segment,
    Shape,
    ShapeFilter,
    SimpleMotor,
    Space,
)

from simbias.hardware.pymunk_gaps import NO_GAPS, Gaps
from simbias.records import Array
from simbias.task.bongoboard import Bongoboard, Robot

Feet = Literal["plate", "separate", "fixed"]

# How the engine is run, chosen for the best agreement of fixed feet with the Lagrangian model.
ERROR_LEFT = 0.8**1000  # of an error in joints or contacts after 1 s: 20% are corrected in each millisecond
SETTLING_STEPS = 20  # of the first frame, repeated: the solver goes on from the forces it last found

ROTORS = "left rotor", "right rotor"  # of the motors, where there is play between them and the legs

# What touches what; legs and pelvis have no shape.
_FLOOR, _WHEEL, _BOARD, _FOOT = 1, 2, 4, 8
_TOUCHES = {_FLOOR: _WHEEL | _BOARD, _WHEEL: _FLOOR | _BOARD, _BOARD: _FLOOR | _WHEEL | _FOOT, _FOOT: _BOARD}
_FLOOR_END = 10.0  # m, on either side
_ROTOR_MASS = 1e-3  # kg; what the motors weigh is in the legs


class World:
    """The engine's world in the pose and motion of a start (6,), contact forces found; one per experiment."""

    def __init__(
        self,
        task: Bongoboard,
        start: Array,
        scale: float,
        feet: Feet,
        iterations: int,
        overlap: float,
        gaps: Gaps = NO_GAPS,
    ) -> None:
        self._robot = robot = task.robot
        self._space = space = Space()
        space.gravity = (-robot.gravity * math.sin(gaps.slope), -robot.gravity * math.cos(gaps.slope))
        space.iterations = iterations
        space.collision_slop = overlap
        space.collision_bias = ERROR_LEFT
        self.bodies = bodies = {
            name: Body(*inertia) for name, inertia in inertias(robot, feet, scale, gaps).items()
        }
        motion = _motion(task, start, feet, overlap, gaps, scale)
        _put(bodies, motion)
        self._wheel, self._board = bodies["wheel"], bodies["board"]
        self._legs = bodies["left leg"], bodies["right leg"]
        self._feet = [bodies[name] for name in sorted(set(_below_legs(feet)))]
        self._ankles = list(zip(self._legs, (bodies[name] for name in _below_legs(feet)), strict=True))
        self._driven = [bodies[name] for name in ROTORS] if gaps.backlash else list(self._legs)
        self._damping, self._stiffness = gaps.ankle_damping / 2, gaps.ankle_stiffness / 2  # of each ankle
        space.add(*bodies.values())
        space.add(*_joints(robot, bodies, feet), *self._friction(gaps))
        if gaps.backlash:
            space.add(*_gears(bodies, gaps.backlash))
        space.add(*_shapes(robot, bodies, feet, space.static_body))
        for _ in range(SETTLING_STEPS):
            space.step(task.time_step)
            _put(bodies, motion)

    def step(self, torque: float, duration: float) -> None:
        """Let the engine make one step of so many seconds under an ankle torque (N m), half on each leg."""
        for body in self._driven:
            body.torque = torque / 2
        for foot in self._feet:
            foot.torque = -torque / len(self._feet)
        if self._damping or self._stiffness:
            for leg, foot in self._ankles:
                moment = self._damping * (foot.angular_velocity - leg.angular_velocity)
                moment += self._stiffness * (foot.angle - leg.angle)
                leg.torque += moment
                foot.torque -= moment
        self._space.step(duration)

    def state(self) -> tuple[float, float, float, float, float, float]:
        """The task's state, read from the bodies' angles and rates."""
        wheel, board, (left, right) = self._wheel, self._board, self._legs
        alpha_w, phi = wheel.angle, board.angle
        d_alpha_w, d_phi = wheel.angular_velocity, board.angular_velocity
        return (
            alpha_w,
            phi - alpha_w,
            (left.angle + right.angle) / 2 - phi,
            d_alpha_w,
            d_phi - d_alpha_w,
            (left.angular_velocity + right.angular_velocity) / 2 - d_phi,
        )

    def _friction(self, gaps: Gaps) -> list[Constraint]:
        """Dry friction at the ankles and below the wheel: motors that brake, as strong as that."""
        brakes = [(leg, foot, gaps.ankle_friction / 2) for leg, foot in self._ankles]
        brakes.append((self._wheel, self._space.static_body, gaps.rolling_resistance))
        motors: list[Constraint] = []
        for a, b, strength in brakes:
            if strength:
                motors.append(SimpleMotor(a, b, 0.0))
                motors[-1].max_force = strength
        return motors

    def contact(self) -> tuple[float, float]:
        """Depth (m) of the board's lowest corner in the floor, and gap (m) between wheel and board."""
        robot, board = self._robot, self._board
        half_length, half_thickness = robot.board_length / 2, robot.board_thickness / 2
        (x, y), (wheel_x, wheel_y) = board.position, self._wheel.position
        c, s = math.cos(board.angle), math.sin(board.angle)
        depth = half_length * abs(s) + half_thickness * c - y
        along = abs((wheel_x - x) * c + (wheel_y - y) * s)
        across = abs((wheel_y - y) * c - (wheel_x - x) * s)
        distance = math.hypot(max(along - half_length, 0.0), max(across - half_thickness, 0.0))
        return depth, distance - robot.wheel_radius


def inertias(
    robot: Robot, feet: Feet, scale: float = 1.0, gaps: Gaps = NO_GAPS
) -> dict[str, tuple[float, float]]:
    """Mass (kg) and moment of inertia about the centre (kg m^2) of every body.

    Those of the robot are multiplied by the scale. A payload is one body with the pelvis.
    """
    leg = _bar(robot.leg_mass, robot.leg_length, 0.0)
    bodies = {
        "wheel": (robot.wheel_mass, robot.wheel_mass * robot.wheel_radius**2 / 2),
        "board": _bar(robot.board_mass, robot.board_length, robot.board_thickness),
        "left leg": leg,
        "right leg": leg,
        "pelvis": (robot.pelvis_mass, robot.pelvis_inertia),
    }
    if feet == "separate":
        foot = _bar(robot.foot_mass / 2, robot.foot_length / 2, robot.ankle_height)
        bodies |= {"left foot": foot, "right foot": foot}
    else:
        bodies["foot"] = _bar(robot.foot_mass, robot.foot_length, robot.ankle_height)
    scaled = {name: (scale * mass, scale * inertia) for name, (mass, inertia) in bodies.items()}
    if gaps.payload_mass:
        mass, inertia = scaled["pelvis"]
        both = mass + gaps.payload_mass
        apart = gaps.payload_x**2 + gaps.payload_y**2
        scaled["pelvis"] = both, inertia + mass * gaps.payload_mass / both * apart
    if gaps.backlash:
        scaled |= dict.fromkeys(ROTORS, (_ROTOR_MASS, gaps.rotor_inertia / 2))
    return scaled


def places(
    task: Bongoboard,
    angles: Array,
    feet: Feet,
    overlap: float = 0.0,
    gaps: Gaps = NO_GAPS,
    scale: float = 1.0,
) -> dict[str, Array]:
    """Centre (x, y) and global angle of every body, (3,), at (alpha_w, alpha_b, theta), real or complex.

    Bodies in contact overlap by half of what they may, so that they touch from the first frame on.
    """
    robot, pose = task.robot, task.pose(angles)
    phi = pose.board_angle
    spacing = robot.foot_length / 2 if feet == "separate" else robot.ankle_spacing
    aside = spacing / 2 * np.array([np.cos(phi), np.sin(phi)])
    foot = pose.ankles - robot.ankle_height / 2 * np.array([-np.sin(phi), np.cos(phi)])
    leg = (pose.ankles + pose.pelvis) / 2
    share = gaps.payload_mass / (gaps.payload_mass + scale * robot.pelvis_mass)
    x, y = share * gaps.payload_x, share * gaps.payload_y
    pelvis = pose.pelvis + np.array([x * np.cos(phi) - y * np.sin(phi), x * np.sin(phi) + y * np.cos(phi)])
    bodies = {  # centre, angle, contacts below
        "wheel": (pose.wheel, pose.wheel_angle, 1),
        "board": (pose.board, phi, 2),
        "foot": (foot, phi, 3),
        "left foot": (foot - aside, phi, 3),
        "right foot": (foot + aside, phi, 3),
        "left leg": (leg - aside, pose.leg_angle, 3),
        "right leg": (leg + aside, pose.leg_angle, 3),
        "pelvis": (pelvis, phi, 3),
        "left rotor": (leg - aside, pose.leg_angle, 3),
        "right rotor": (leg + aside, pose.leg_angle, 3),
    }
    return {
        name: np.array([x, y - contacts * overlap / 2, angle])
        for name, ((x, y), angle, contacts) in bodies.items()
    }


def _motion(
    task: Bongoboard, start: Array, feet: Feet, overlap: float, gaps: Gaps, scale: float
) -> dict[str, tuple[Array, Array]]:
    """Place and velocity of every body, (3,) each, at a start (6,)."""
    h = 1e-30  # complex step: the velocities are exact
    placed = places(task, start[:3] + 1j * h * start[3:], feet, overlap, gaps, scale)
    return {name: (place.real, place.imag / h) for name, place in placed.items()}


def _put(bodies: dict[str, Body], motion: dict[str, tuple[Array, Array]]) -> None:
    """Give the bodies their places and velocities."""
    for name, body in bodies.items():
        (x, y, angle), (d_x, d_y, d_angle) = motion[name]
        body.position, body.angle = (x, y), angle
        body.velocity, body.angular_velocity = (d_x, d_y), d_angle


def _joints(robot: Robot, bodies: dict[str, Body], feet: Feet) -> list[PivotJoint]:
    """Ankles and hips, a parallelogram; a fixed foot is pinned to the board at both ends."""
    half_leg, half_foot, half_height = robot.leg_length / 2, robot.foot_length / 2, robot.ankle_height / 2
    joints = []
    for name, foot in zip(("left leg", "right leg"), _below_legs(feet), strict=True):
        leg = bodies[name]
        joints.append(PivotJoint(bodies[foot], leg, leg.local_to_world((0.0, -half_leg))))
        joints.append(PivotJoint(bodies["pelvis"], leg, leg.local_to_world((0.0, half_leg))))
    if feet == "fixed":
        board, plate = bodies["board"], bodies["foot"]
        for end in (-half_foot, half_foot):
            joints.append(PivotJoint(board, plate, plate.local_to_world((end, -half_height))))
    for joint in joints:
        joint.error_bias = ERROR_LEFT
    return joints


def _gears(bodies: dict[str, Body], backlash: float) -> list[Constraint]:
    """Rotors that turn about the legs' centres, as far as the play goes."""
    joints: list[Constraint] = []
    for leg, rotor in ((bodies["left leg"], bodies[ROTORS[0]]), (bodies["right leg"], bodies[ROTORS[1]])):
        joints.append(PivotJoint(leg, rotor, (0.0, 0.0), (0.0, 0.0)))
        joints.append(RotaryLimitJoint(leg, rotor, -backlash / 2, backlash / 2))
    for joint in joints:
        joint.error_bias = ERROR_LEFT
    return joints


def _shapes(robot: Robot, bodies: dict[str, Body], feet: Feet, ground: Body) -> list[Shape]:
    """The shapes of floor, wheel and board, and of feet that stand on the board by contact."""
    shapes: list[tuple[int, Shape]] = [
        (_FLOOR, Segment(ground, (-_FLOOR_END, 0.0), (_FLOOR_END, 0.0), 0.0)),
        (_WHEEL, Circle(bodies["wheel"], robot.wheel_radius)),
        (_BOARD, Poly.create_box(bodies["board"], (robot.board_length, robot.board_thickness))),
    ]
    if feet != "fixed":
        names = sorted(set(_below_legs(feet)))
        sole = (robot.foot_length / len(names), robot.ankle_height)
        shapes += [(_FOOT, Poly.create_box(bodies[name], sole)) for name in names]
    for kind, shape in shapes:
        shape.filter = ShapeFilter(categories=kind, mask=_TOUCHES[kind])
        shape.friction = math.sqrt(robot.friction)  # a contact's friction is the product of the two
    return [shape for _, shape in shapes]


def _below_legs(feet: Feet) -> tuple[str, str]:
    """Names of the feet below the left and the right leg."""
    return ("left foot", "right foot") if feet == "separate" else ("foot", "foot")


def _bar(mass: float, length: float, thickness: float) -> tuple[float, float]:
    """Mass and moment of inertia of a solid bar about its centre."""
    return mass, mass * (length**2 + thickness**2) / 12
