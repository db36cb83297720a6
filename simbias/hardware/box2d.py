"""The bongoboard in Box2D, another 2D physics engine in place of the robot."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, final

import numpy as np
from pydantic import Field

from simbias.config.numbers import Count
from simbias.hardware.bongoboard_running import Running, motion
from simbias.hardware.loop import Record, experiment
from simbias.hardware.pymunk_world import inertias
from simbias.interfaces import Hardware, HardwareError, Policy
from simbias.messages import words
from simbias.records import Array, Rollout
from simbias.simulation.noise import QUIET, Noise, Variances
from simbias.task.bongoboard import Bongoboard

EXTRA = "pip install 'simbias[box2d]'"
UNIT = 0.01  # m: the engine lets bodies overlap by 0.005 of its units, whatever they are
SKIN = 0.01  # units by which it surrounds polygons and edges
OVERLAP = 0.005 * UNIT  # m
SETTLING_STEPS = 20  # of the first frame, repeated: the solver goes on from the forces it last found
FLOOR_END = 10.0  # m, on either side

# What touches what; legs and pelvis have no shape.
_FLOOR, _WHEEL, _BOARD, _FOOT = 1, 2, 4, 8
_TOUCHES = {_FLOOR: _WHEEL | _BOARD, _WHEEL: _FLOOR | _BOARD, _BOARD: _FLOOR | _WHEEL | _FOOT, _FOOT: _BOARD}


@cache
def box2d() -> Any:
    """The library.

    Raises
    ------
    ValueError
        If it is not installed; the line says how to install it.
    """
    try:
        import Box2D
    except ImportError as error:
        raise ValueError(f"Box2D is not installed ({words(error)}): {EXTRA}") from error
    return Box2D


@final
class Box2dBongoboard(Hardware):
    """Wheel, board, foot plate, two legs and pelvis as rigid bodies; the plate stands by contact.

    The engine works in single precision. A step finds velocities first and then moves by them, as that of the
    Lagrangian model does.

    Parameters
    ----------
    task
        Geometry, masses, time step (a frame is one step of the engine) and failure.
    inertia_error
        Every mass and moment of inertia is multiplied by 1 + inertia_error.
    noise
        Variances on the torque and on what the policy sees, by name (`Noise`).
    record
        What cost and learning get to see: the true states, or the measured ones.
    iterations
        Of the engine's solver in each frame.
    detachment
        Gap, in m, above which the board has left the wheel.

    Raises
    ------
    ValueError
        If Box2D is not installed.
    """

    def __init__(
        self,
        task: Bongoboard,
        inertia_error: Annotated[float, Field(ge=-0.99, le=100)] = 0.0,
        noise: Variances = QUIET,
        record: Record = "true_state",
        iterations: Count = 100,
        detachment: Annotated[float, Field(ge=1e-9, le=1.0)] = 1e-3,
    ) -> None:
        box2d()
        self._task = task
        self._scale = 1.0 + inertia_error
        self._noise = Noise(task, noise)
        self._record = record
        self._iterations = iterations
        self._detachment = detachment

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """One experiment with theta (p,) from start (6,); its cost is not set."""
        if not np.isfinite(start).all():
            raise HardwareError(f"the robot cannot start at {start}")
        robot = Running(self._task, self.build, start, self._detachment)
        return experiment(self._task, robot, policy, theta, self._noise.draw(rng), self._record)

    def build(self, start: Array) -> World:
        """The engine's world at a start (6,), as an experiment begins with it."""
        return World(self._task, start, self._scale, self._iterations)


class World:
    """The engine's world in the pose and motion of a start (6,), contact forces found."""

    def __init__(self, task: Bongoboard, start: Array, scale: float, iterations: int) -> None:
        self._time_step, self._iterations = task.time_step, iterations
        robot = task.robot
        world = self._world = box2d().b2World(gravity=(0.0, -robot.gravity / UNIT), doSleep=False)
        world.continuousPhysics = False
        begin = motion(task, start, OVERLAP)
        self.bodies = bodies = {name: world.CreateDynamicBody() for name in inertias(robot, "plate", scale)}
        self._put(begin)
        self._add_shapes(task)
        for name, (mass, inertia) in inertias(robot, "plate", scale).items():
            bodies[name].massData = box2d().b2MassData(mass=mass, center=(0, 0), I=inertia / UNIT**2)
        half_leg = robot.leg_length / 2 / UNIT
        for name in ("left leg", "right leg"):
            leg = bodies[name]
            for other, end in (("foot", -half_leg), ("pelvis", half_leg)):
                world.CreateRevoluteJoint(
                    bodyA=bodies[other], bodyB=leg, anchor=leg.GetWorldPoint((0.0, end))
                )
        for _ in range(SETTLING_STEPS):
            self.step(0.0)
            self._put(begin)

    def _put(self, begin: dict[str, tuple[Array, Array]]) -> None:
        """Give the bodies their places and velocities."""
        for name, body in self.bodies.items():
            (x, y, angle), (d_x, d_y, d_angle) = (part.tolist() for part in begin[name])
            body.transform = ((x / UNIT, y / UNIT), angle)
            body.linearVelocity, body.angularVelocity = (d_x / UNIT, d_y / UNIT), d_angle

    def _add_shapes(self, task: Bongoboard) -> None:
        """The shapes of floor, wheel, board and foot plate; polygons without their skin are smaller by it."""
        engine, robot = box2d(), task.robot

        def box(length: float, height: float) -> Any:
            return engine.b2PolygonShape(box=(length / 2 / UNIT - SKIN, height / 2 / UNIT - SKIN))

        end = FLOOR_END / UNIT
        floor = engine.b2EdgeShape(vertices=[(-end, -SKIN), (end, -SKIN)])
        shapes = (
            (_FLOOR, self._world.CreateStaticBody(), floor),
            (_WHEEL, self.bodies["wheel"], engine.b2CircleShape(radius=robot.wheel_radius / UNIT)),
            (_BOARD, self.bodies["board"], box(robot.board_length, robot.board_thickness)),
            (_FOOT, self.bodies["foot"], box(robot.foot_length, robot.ankle_height)),
        )
        for kind, body, shape in shapes:
            fixture = engine.b2FixtureDef(shape=shape, friction=robot.friction, density=0.0, restitution=0.0)
            fixture.categoryBits, fixture.maskBits = kind, _TOUCHES[kind]
            body.CreateFixture(fixture)

    def step(self, torque: float) -> None:
        """One frame under an ankle torque (N m), half on each leg."""
        asked = torque / UNIT**2
        for name in ("left leg", "right leg"):
            self.bodies[name].ApplyTorque(asked / 2, True)
        self.bodies["foot"].ApplyTorque(-asked, True)
        self._world.Step(self._time_step, self._iterations, self._iterations)

    def state(self) -> Array:
        """The task's state (6,), of the bodies' angles and rates."""
        wheel, board, left, right = (
            np.array([self.bodies[name].angle, self.bodies[name].angularVelocity])
            for name in ("wheel", "board", "left leg", "right leg")
        )
        return np.column_stack([wheel, board - wheel, (left + right) / 2 - board]).ravel()

    def wheel_and_board(self) -> tuple[Array, Array]:
        """Centre x, y (m) and global angle of wheel and board, (3,) each."""
        wheel, board = (
            np.array([*(UNIT * body.worldCenter), body.angle])
            for body in (self.bodies["wheel"], self.bodies["board"])
        )
        return wheel, board
