"""A drawing of the bongoboard, to scale (Fig. 3(a))."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes

from simbias.core.records import Array
from simbias.robots.bongoboard.bodies import Assembly
from simbias.robots.bongoboard.task import Bongoboard
from simbias.robots.drawing import LINE, Disc, draw_parts, move_parts

BOARD, WHEEL = "0.55", "0.88"  # greys
GREYS = {"wheel": WHEEL, "sector": LINE, "board": BOARD}
LEG_WIDTH, JOINT_RADIUS = 0.04, 0.012  # m; neither is a parameter of the task


def draw(
    axes: Axes, task: Bongoboard, state: Array, *, color: str = "0.4", muted: bool = False
) -> dict[str, Artist]:
    """Draw floor, wheel, board and robot in m at the state (6,); return the artists by name.

    Lengths are the task's, except for the upper body: the task defines only its mass and inertia. A dark
    sector shows the wheel's rotation. The robot has the given colour; a muted drawing is pale.
    """
    parts = _parts(task, state)
    colors = {name: LINE if name.endswith(("ankle", "hip")) else GREYS.get(name, color) for name in parts}
    artists = draw_parts(axes, parts, colors, muted)
    return {"floor": axes.axhline(0.0, color=LINE, linewidth=1.0, zorder=0), **artists}


def move(artists: Mapping[str, Artist], task: Bongoboard, state: Array, *, muted: bool = False) -> None:
    """Move the artists of `draw` to another state (6,)."""
    move_parts(artists, _parts(task, state), muted)


def _parts(task: Bongoboard, state: Array) -> dict[str, Disc | Array]:
    """Every part at the state (6,), from back to front."""
    robot, pose, places = task.robot, task.pose(state[:3]), Assembly(task).places(state[:3])
    aside = robot.ankle_spacing / 2 * np.array([np.cos(pose.board_angle), np.sin(pose.board_angle)])
    r = robot.wheel_radius
    around = np.linspace(-0.3, 0.3, 9)
    sector = r * np.vstack([(0.0, 0.0), np.column_stack([-np.sin(around), np.cos(around)])])
    joints = {"ankle": pose.ankles, "hip": pose.pelvis}
    return {
        "wheel": Disc(pose.wheel, r),
        "sector": _place(sector, places["wheel"]),
        "board": _place(_box(robot.board_length, robot.board_thickness), places["board"]),
        "foot": _place(_box(robot.foot_length, robot.ankle_height), places["foot"]),
        "upper body": _place(_upper_body(task), places["pelvis"]),
        **{leg: _place(_box(LEG_WIDTH, robot.leg_length), places[leg]) for leg in ("left leg", "right leg")},
        **{f"left {name}": Disc(place - aside, JOINT_RADIUS) for name, place in joints.items()},
        **{f"right {name}": Disc(place + aside, JOINT_RADIUS) for name, place in joints.items()},
    }


def _upper_body(task: Bongoboard) -> Array:
    """Outline (k, 2) of a trunk with a head, about the pelvis' centre."""
    half, height = task.robot.ankle_spacing / 2 + LEG_WIDTH, 0.7 * task.robot.leg_length
    head, around = height / 3, np.linspace(-2.6, 2.6, 31)
    outline = np.column_stack([-np.sin(around), np.cos(around)]) * head + (0.0, height + 0.95 * head)
    trunk = [(half, height), (half, -LEG_WIDTH), (-half, -LEG_WIDTH), (-half, height)]
    return np.vstack([trunk, outline[::-1]])


def _box(width: float, height: float) -> Array:
    """Corners (4, 2) of a box about the origin."""
    return np.array([(-width, -height), (width, -height), (width, height), (-width, height)]) / 2


def _place(points: Array, place: Array) -> Array:
    """The points (k, 2) of a body at a place: x, y and angle in rad."""
    c, s = np.cos(place[2]), np.sin(place[2])
    return points @ np.array([(c, s), (-s, c)]) + place[:2]
