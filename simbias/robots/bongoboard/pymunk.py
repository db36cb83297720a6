"""The bongoboard in pymunk, a 2D physics engine instead of the robot (Section VI-A).

The engine (Chipmunk) works in maximal coordinates: contacts and joints are impulses, solved iteratively. Its
step first moves all bodies by their velocities and then computes the new velocities.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import final

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

from simbias.core.ranges import Count
from simbias.core.records import Array
from simbias.robots.bongoboard.bodies import (
    BOARD,
    FLOOR,
    FLOOR_END,
    FOOT,
    ROTORS,
    SETTLING_STEPS,
    TOUCHES,
    WHEEL,
    Assembly,
    Feet,
    Place,
    state_of,
)
from simbias.robots.bongoboard.gaps import NO_GAPS, Gaps
from simbias.robots.bongoboard.hardware import Depth, EngineBongoboard, InertiaError
from simbias.robots.bongoboard.task import Bongoboard, Robot
from simbias.simulation.control_loop import Record
from simbias.simulation.noise import QUIET, Variances

# `body.torque = torque` would take two more calls in every frame.
_set_torque: Callable[[Body, float], None] = vars(Body)["torque"].fset

# Engine settings, chosen for the best agreement of fixed feet with the Lagrangian model.
ERROR_LEFT = 0.8**1000  # share of a joint or contact error left after 1 s: 20% are corrected per millisecond


@final
class PymunkBongoboard(EngineBongoboard):
    """Wheel, board, feet, two legs and pelvis as rigid bodies; the feet stand on the board by contact alone.

    Parameters
    ----------
    task, inertia_error, noise, record, detachment
        As for every `EngineBongoboard`; a frame is one step of the engine.
    feet
        "plate": one plate under both ankles; "separate": the plate cut in two, an ankle above the middle of
        each half; "fixed": the plate joined to the board, as in the Lagrangian model.
    iterations
        Iterations of the engine's solver in each frame.
    overlap
        Depth, in m, by which bodies in contact may overlap.
    gaps
        Differences from its model (`Gaps`). Noise on the torque also passes through the motor.
    """

    def __init__(
        self,
        task: Bongoboard,
        inertia_error: InertiaError = 0.0,
        feet: Feet = "plate",
        noise: Variances = QUIET,
        record: Record = "true_state",
        iterations: Count = 50,
        overlap: Depth = 1e-4,
        detachment: Depth = 1e-3,
        gaps: Gaps = NO_GAPS,
    ) -> None:
        super().__init__(task, inertia_error, noise, record, detachment, overlap, feet, gaps)
        self._iterations = iterations

    def build(self, start: Array) -> World:
        """The engine's world at an experiment's start (6,)."""
        return World(self._assembly, start, self._iterations)


class World:
    """The engine's world in the pose and motion of a start (6,), contacts settled; one per experiment."""

    def __init__(self, assembly: Assembly, start: Array, iterations: int) -> None:
        robot, feet, gaps = assembly.task.robot, assembly.feet, assembly.gaps
        self._time_step = assembly.task.time_step
        self._space = space = Space()
        space.gravity = (-robot.gravity * math.sin(gaps.slope), -robot.gravity * math.cos(gaps.slope))
        space.iterations = iterations
        space.collision_slop = assembly.overlap
        space.collision_bias = ERROR_LEFT
        self.bodies = bodies = {name: Body(*inertia) for name, inertia in assembly.inertias().items()}
        begin = assembly.motion(start)
        _put(bodies, begin)
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
            space.step(self._time_step)
            _put(bodies, begin)

    def step(self, torque: float) -> None:
        """One frame under an ankle torque (N m), half on each leg."""
        for body in self._driven:
            _set_torque(body, torque / 2)
        for foot in self._feet:
            _set_torque(foot, -torque / len(self._feet))
        if self._damping or self._stiffness:
            for leg, foot in self._ankles:
                moment = self._damping * (foot.angular_velocity - leg.angular_velocity)
                moment += self._stiffness * (foot.angle - leg.angle)
                leg.torque += moment
                foot.torque -= moment
        self._space.step(self._time_step)

    def state(self) -> list[float]:
        """The task's state (6,), from the bodies' angles and rates."""
        bodies = (self._wheel, self._board, *self._legs)
        return state_of(*((body.angle, body.angular_velocity) for body in bodies))

    def wheel_and_board(self) -> tuple[Place, Place]:
        """Centre x, y (m) and global angle of wheel and board."""
        wheel, board = self._wheel, self._board
        return (*wheel.position, wheel.angle), (*board.position, board.angle)

    def _friction(self, gaps: Gaps) -> list[Constraint]:
        """Dry friction at the ankles and below the wheel, as braking motors of limited strength."""
        brakes = [(leg, foot, gaps.ankle_friction / 2) for leg, foot in self._ankles]
        brakes.append((self._wheel, self._space.static_body, gaps.rolling_resistance))
        motors: list[Constraint] = []
        for a, b, strength in brakes:
            if strength:
                motors.append(SimpleMotor(a, b, 0.0))
                motors[-1].max_force = strength
        return motors


def _put(bodies: dict[str, Body], begin: dict[str, tuple[Array, Array]]) -> None:
    """Set the bodies' places and velocities."""
    for name, body in bodies.items():
        (x, y, angle), (d_x, d_y, d_angle) = begin[name]
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
    """Rotors that turn about the legs' centres, within the backlash."""
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
        (FLOOR, Segment(ground, (-FLOOR_END, 0.0), (FLOOR_END, 0.0), 0.0)),
        (WHEEL, Circle(bodies["wheel"], robot.wheel_radius)),
        (BOARD, Poly.create_box(bodies["board"], (robot.board_length, robot.board_thickness))),
    ]
    if feet != "fixed":
        names = sorted(set(_below_legs(feet)))
        sole = (robot.foot_length / len(names), robot.ankle_height)
        shapes += [(FOOT, Poly.create_box(bodies[name], sole)) for name in names]
    for kind, shape in shapes:
        shape.filter = ShapeFilter(categories=kind, mask=TOUCHES[kind])
        shape.friction = math.sqrt(robot.friction)  # a contact's friction is the product of both shapes'
    return [shape for _, shape in shapes]


def _below_legs(feet: Feet) -> tuple[str, str]:
    """Names of the feet below the left and the right leg."""
    return ("left foot", "right foot") if feet == "separate" else ("foot", "foot")
