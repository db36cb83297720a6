"""The bongoboard in MuJoCo, in three dimensions, instead of the robot."""

from __future__ import annotations

from typing import final

import numpy as np

from simbias.core.ranges import Count
from simbias.core.records import Array
from simbias.robots.bongoboard.bodies import Assembly, Place, state_of
from simbias.robots.bongoboard.hardware import Depth, EngineBongoboard, InertiaError
from simbias.robots.bongoboard.task import Bongoboard, Robot
from simbias.robots.mujoco.parameters import mujoco
from simbias.simulation.control_loop import Record
from simbias.simulation.noise import QUIET, Variances

WIDTH = 0.3  # m, of wheel, board and foot plate, perpendicular to the plane of motion
STIFFNESS = 4  # engine steps in which contacts and joints correct an error
LEGS = [9, 11]  # indices among the positions
SLIDES = {"x": "1 0 0", "z": "0 0 1"}
OVERLAP = 2e-6  # m at the start, so that bodies touch from the first frame on


@final
class MujocoBongoboard(EngineBongoboard):
    """Wheel, board, foot plate, two legs and pelvis as rigid bodies, each of which moves in one plane.

    Wheel, board and plate touch by contacts with three-dimensional friction; the parallelogram of legs and
    pelvis is made of joints. MuJoCo's constraints are soft: contacts give way a little.

    Parameters
    ----------
    task, inertia_error, noise, record, detachment
        As for every `EngineBongoboard`.
    steps
        Engine steps per frame.

    Raises
    ------
    ValueError
        If MuJoCo is not installed.
    """

    def __init__(
        self,
        task: Bongoboard,
        inertia_error: InertiaError = 0.0,
        noise: Variances = QUIET,
        record: Record = "true_state",
        steps: Count = 2,
        detachment: Depth = 1e-3,
    ) -> None:
        super().__init__(task, inertia_error, noise, record, detachment, OVERLAP)
        self._steps = steps
        self.model = mujoco().MjModel.from_xml_string(mjcf(self._assembly, steps))

    def build(self, start: Array) -> World:
        """The engine's world at an experiment's start (6,)."""
        return World(self._assembly, self.model, start, self._steps)


class World:
    """The engine's world in the pose and motion of a start (6,).

    Its positions are x, z and angle of wheel, board and plate, then the angles of the left leg, the hip and
    the right leg.
    """

    def __init__(self, assembly: Assembly, model: object, start: Array, steps: int) -> None:
        self._model, self._steps = model, steps
        self.data = mujoco().MjData(model)
        begin = assembly.motion(start)
        for values, part in ((self.data.qpos, 0), (self.data.qvel, 1)):
            foot, leg = begin["foot"][part][2], begin["left leg"][part][2]
            bodies = (begin[name][part] for name in ("wheel", "board", "foot"))
            values[:] = [*np.concatenate(list(bodies)), leg - foot, foot - leg, leg - foot]

    def step(self, torque: float) -> None:
        """One frame under an ankle torque (N m), half on each leg."""
        self.data.ctrl[:] = torque / 2
        mujoco().mj_step(self._model, self.data, nstep=self._steps)

    def state(self) -> list[float]:
        """The task's state (6,), from the engine's positions and velocities."""
        turns = np.stack([self.data.qpos, self.data.qvel], axis=1)
        leg = (turns[8] + turns[LEGS].mean(axis=0)).tolist()
        return state_of(turns[2].tolist(), turns[5].tolist(), leg, leg)

    def wheel_and_board(self) -> tuple[Place, Place]:
        """Centre x, y (m) and global angle of wheel and board."""
        places = self.data.qpos.tolist()
        return places[:3], places[3:6]


def mjcf(assembly: Assembly, steps: int) -> str:
    """The robot as MJCF; angles are counter-clockwise when x points right and z up."""
    robot, seconds = assembly.task.robot, assembly.task.time_step / steps
    soft = f'solref="{STIFFNESS * seconds} 1" solimp="0.99 0.999 0.0001"'
    return f"""
    <mujoco model="bongoboard">
      <compiler angle="radian"/>
      <option timestep="{seconds}" gravity="0 0 {-robot.gravity}" integrator="implicitfast" cone="elliptic"
        impratio="100" iterations="100" tolerance="1e-10"/>
      <default><geom contype="0" conaffinity="0"/></default>
      <worldbody>{_bodies(robot, assembly.inertias())}</worldbody>
      <contact>{_pairs(robot.friction, soft)}</contact>
      <equality>
        <joint joint1="right leg" joint2="left leg" polycoef="0 1 0 0 0" {soft}/>
        <joint joint1="hip" joint2="left leg" polycoef="0 -1 0 0 0" {soft}/>
      </equality>
      <actuator>
        <motor name="left ankle" joint="left leg"/>
        <motor name="right ankle" joint="right leg"/>
      </actuator>
    </mujoco>"""


def _bodies(robot: Robot, masses: dict[str, tuple[float, float]]) -> str:
    """Floor, wheel, board and foot plate; the plate carries the legs, and the left leg the pelvis."""
    mass, inertia = masses["pelvis"]
    pelvis = (
        f'<body name="pelvis" pos="0 0 {robot.leg_length}">{_hinge("hip")}'
        f'<inertial mass="{mass}" pos="{robot.ankle_spacing / 2} 0 0" '
        f'diaginertia="{inertia} {inertia} {inertia}"/></body>'
    )

    def leg(name: str, side: float, above: str = "") -> str:
        return (
            f'<body name="{name}" pos="{side * robot.ankle_spacing / 2} 0 {robot.ankle_height / 2}">'
            f"{_hinge(name)}{_inertial(*masses[name], robot.leg_length / 2)}{above}</body>"
        )

    return f"""
        <geom name="floor" type="plane" size="10 10 1"/>
        <body name="wheel">{_plane("wheel")}{_inertial(*masses["wheel"])}
          <geom name="wheel" type="capsule" size="{robot.wheel_radius}"
            fromto="0 {-WIDTH / 2} 0 0 {WIDTH / 2} 0"/>
        </body>
        <body name="board">{_plane("board")}{_inertial(*masses["board"])}
          {_box("board", robot.board_length, robot.board_thickness)}</body>
        <body name="foot">{_plane("foot")}{_inertial(*masses["foot"])}
          {_box("foot", robot.foot_length, robot.ankle_height)}
          {leg("left leg", -1.0, pelvis)}{leg("right leg", 1.0)}</body>"""


def _inertial(mass: float, inertia: float, height: float = 0.0) -> str:
    """Mass (kg), moment of inertia (kg m^2), and height (m) of the centre above the body's origin."""
    other = 0.6 * inertia  # about the in-plane axes, around which nothing turns
    return f'<inertial mass="{mass}" pos="0 0 {height}" diaginertia="{other} {inertia} {other}"/>'


def _hinge(name: str) -> str:
    """MJCF of a hinge in the plane of motion."""
    return f'<joint name="{name}" type="hinge" axis="0 -1 0"/>'


def _plane(name: str) -> str:
    """The joints of a body that moves freely in the plane."""
    slides = (f'<joint name="{name} {axis}" type="slide" axis="{way}"/>' for axis, way in SLIDES.items())
    return "".join(slides) + _hinge(f"{name} angle")


def _box(name: str, length: float, height: float) -> str:
    """MJCF of the shape of the board or the foot plate."""
    return f'<geom name="{name}" type="box" size="{length / 2} {WIDTH / 2} {height / 2}"/>'


def _pairs(friction: float, soft: str) -> str:
    """MJCF of the pairs of shapes that may touch, with their friction."""
    return "".join(
        f'<pair geom1="{a}" geom2="{b}" condim="3" friction="{friction} {friction} 0 0 0" {soft}/>'
        for a, b in (("floor", "wheel"), ("floor", "board"), ("wheel", "board"), ("board", "foot"))
    )
