"""The bongoboard in Box2D, another 2D physics engine instead of the robot."""

from __future__ import annotations

from typing import Any, final

from simbias.core.extras import library
from simbias.core.ranges import Count
from simbias.core.records import Array
from simbias.robots.bongoboard.bodies import (
    BOARD,
    FLOOR,
    FLOOR_END,
    FOOT,
    SETTLING_STEPS,
    TOUCHES,
    WHEEL,
    Assembly,
    Place,
    state_of,
)
from simbias.robots.bongoboard.hardware import Depth, EngineBongoboard, InertiaError
from simbias.robots.bongoboard.task import Bongoboard, Robot
from simbias.simulation.control_loop import Record
from simbias.simulation.noise import QUIET, Variances

UNIT = 0.01  # m: the engine lets bodies overlap by 0.005 of its units
SKIN = 0.01  # units, skin around polygons and edges
OVERLAP = 0.005 * UNIT  # m


def box2d() -> Any:
    """Import Box2D when needed; ValueError if it is not installed."""
    return library("Box2D", "Box2D", "box2d")


@final
class Box2dBongoboard(EngineBongoboard):
    """Wheel, board, foot plate, two legs and pelvis as rigid bodies; the plate stands by contact.

    The engine works in single precision. Its steps compute velocities first and then move bodies by them,
    like the Lagrangian model's.

    Parameters
    ----------
    task, inertia_error, noise, record, detachment
        As for every `EngineBongoboard`; a frame is one step of the engine.
    iterations
        Iterations of the engine's solver in each frame.

    Raises
    ------
    ValueError
        If Box2D is not installed.
    """

    def __init__(
        self,
        task: Bongoboard,
        inertia_error: InertiaError = 0.0,
        noise: Variances = QUIET,
        record: Record = "true_state",
        iterations: Count = 100,
        detachment: Depth = 1e-3,
    ) -> None:
        box2d()
        super().__init__(task, inertia_error, noise, record, detachment, OVERLAP)
        self._iterations = iterations

    def build(self, start: Array) -> World:
        """The engine's world at an experiment's start (6,)."""
        return World(self._assembly, start, self._iterations)


class World:
    """The engine's world in the pose and motion of a start (6,), with settled contact forces."""

    def __init__(self, assembly: Assembly, start: Array, iterations: int) -> None:
        robot, inertias = assembly.task.robot, assembly.inertias()
        self._time_step, self._iterations = assembly.task.time_step, iterations
        world = self._world = box2d().b2World(gravity=(0.0, -robot.gravity / UNIT), doSleep=False)
        world.continuousPhysics = False
        begin = assembly.motion(start)
        self.bodies = bodies = {name: world.CreateDynamicBody() for name in inertias}
        self._put(begin)
        self._add_shapes(robot)
        for name, (mass, inertia) in inertias.items():
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
        """Set the bodies' places and velocities."""
        for name, body in self.bodies.items():
            (x, y, angle), (d_x, d_y, d_angle) = (part.tolist() for part in begin[name])
            body.transform = ((x / UNIT, y / UNIT), angle)
            body.linearVelocity, body.angularVelocity = (d_x / UNIT, d_y / UNIT), d_angle

    def _add_shapes(self, robot: Robot) -> None:
        """Add the shapes of floor, wheel, board and foot plate; polygons are made smaller by their skin."""
        engine = box2d()

        def box(length: float, height: float) -> Any:
            return engine.b2PolygonShape(box=(length / 2 / UNIT - SKIN, height / 2 / UNIT - SKIN))

        end = FLOOR_END / UNIT
        floor = engine.b2EdgeShape(vertices=[(-end, -SKIN), (end, -SKIN)])
        shapes = (
            (FLOOR, self._world.CreateStaticBody(), floor),
            (WHEEL, self.bodies["wheel"], engine.b2CircleShape(radius=robot.wheel_radius / UNIT)),
            (BOARD, self.bodies["board"], box(robot.board_length, robot.board_thickness)),
            (FOOT, self.bodies["foot"], box(robot.foot_length, robot.ankle_height)),
        )
        for kind, body, shape in shapes:
            fixture = engine.b2FixtureDef(shape=shape, friction=robot.friction, density=0.0, restitution=0.0)
            fixture.categoryBits, fixture.maskBits = kind, TOUCHES[kind]
            body.CreateFixture(fixture)

    def step(self, torque: float) -> None:
        """One frame under an ankle torque (N m), half on each leg."""
        asked = torque / UNIT**2
        for name in ("left leg", "right leg"):
            self.bodies[name].ApplyTorque(asked / 2, True)
        self.bodies["foot"].ApplyTorque(-asked, True)
        self._world.Step(self._time_step, self._iterations, self._iterations)

    def state(self) -> list[float]:
        """The task's state (6,), from the bodies' angles and rates."""
        bodies = (self.bodies[name] for name in ("wheel", "board", "left leg", "right leg"))
        return state_of(*((body.angle, body.angularVelocity) for body in bodies))

    def wheel_and_board(self) -> tuple[Place, Place]:
        """Centre x, y (m) and global angle of wheel and board."""
        wheel, board = self.bodies["wheel"], self.bodies["board"]
        (wheel_x, wheel_y), (x, y) = wheel.worldCenter, board.worldCenter
        return (UNIT * wheel_x, UNIT * wheel_y, wheel.angle), (UNIT * x, UNIT * y, board.angle)
