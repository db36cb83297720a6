"""A drawing of a robot's MuJoCo model: a stick figure of its geoms, or MuJoCo's rendering."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from simbias.core import Task
from simbias.core.files import ConfigFile
from simbias.core.records import Array
from simbias.robots.mujoco.mjcf import Mechanism
from simbias.robots.mujoco.parameters import mujoco
from simbias.robots.mujoco.rendering import (
    Image,
    NoRendererError,
    Rendering,
    View,
    axes_of,
    solid_geoms,
    view_of,
)

EDGE_ON = 1e-9  # of the longest edge: shorter projections count as along the line of sight
HALF_TURN = np.linspace(-np.pi / 2, np.pi / 2, 17)  # rad, along half the rim of a disc


@dataclass(frozen=True)
class FigureFile:
    """Source of a drawing: a file, as for `simbias.robots.mujoco.mjcf.Mechanism`."""

    file: ConfigFile
    joints: list[str] | None = None  # in the order of the states, as for the nominal model
    actuators: list[str] | None = None
    view: View | None = None  # the visible plane; None: the plane in which the robot moves
    rendered: bool | None = None  # by MuJoCo, if OpenGL can run; None: only if the stick figure lacks a geom


class Figure:
    """A stick figure: spheres are discs, capsules and cylinders are bars (discs end-on), boxes are outlines.

    Other geoms are left out. If there are any, MuJoCo renders the robot if possible. ValueError if the file
    cannot be read or does not fit the task.
    """

    def __init__(self, task: Task, source: FigureFile) -> None:
        self._robot = Mechanism(task, source.file, source.joints, source.actuators)
        self.source_files, self.joints = self._robot.source_files, self._robot.joints
        view = source.view or view_of(self._robot.model)
        self._view = axes_of(view)
        self._data: Any = mujoco().MjData(self._robot.model)
        self.thickness: dict[str, float] = {}  # of each part, in m
        self._ends: dict[str, tuple[int, Array]] = {}  # index of a geom, and points (k, 3) about its centre
        for index in range(self._robot.model.ngeom):
            geom, points = self._robot.model.geom(index), self._local(index)
            if points is not None:
                name = geom.name or f"geom {index}"
                self.thickness[name] = 2 * float(geom.size[0])
                self._ends[name] = (index, points)
        lacks = len(self._ends) < len(solid_geoms(self._robot.model))
        rendered = lacks if source.rendered is None else source.rendered
        self._rendering = Rendering(self._robot, view) if rendered else None

    def image(self, x: Array) -> Image | None:
        """The rendered image at the state x (n,); None if a stick figure is drawn."""
        if self._rendering is not None:
            try:
                return self._rendering.image(x)
            except NoRendererError as error:
                warnings.warn(f"a stick figure is drawn: {error}", stacklevel=2)
                self._rendering = None
        return None

    def _local(self, index: int) -> Array | None:
        """Points (k, 3) of a geom about its centre, in the geom's frame; None if it is not drawn."""
        kind = mujoco().mjtGeom(int(self._robot.model.geom_type[index])).name
        size = self._robot.model.geom_size[index]
        if kind == "mjGEOM_SPHERE":
            return np.zeros((1, 3))
        if kind in ("mjGEOM_CAPSULE", "mjGEOM_CYLINDER"):
            return np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]])
        if kind == "mjGEOM_BOX":
            return np.diag(size)  # half of each edge
        return None

    def points(self, x: Array) -> dict[str, Array]:
        """The points (k, 2) of every part in m, at the state x (n,)."""
        model, data = self._robot.model, self._data
        data.qpos[:] = self._robot.physics(x[None])[0, 1 : 1 + model.nq]
        mujoco().mj_kinematics(model, data)
        placed = {}
        for name, (geom, points) in self._ends.items():
            centre, turned = data.geom_xpos[geom], points @ data.geom_xmat[geom].reshape(3, 3).T
            if len(points) == 3:
                placed[name] = _outline(centre[self._view], turned[:, self._view])
            elif len(points) == 2:
                size, half = model.geom_size[geom], turned[1, self._view]
                round_ends = model.geom_type[geom] == mujoco().mjtGeom.mjGEOM_CAPSULE
                placed[name] = _bar(centre[self._view], half, size[1], size[0], round_ends)
            else:
                placed[name] = (centre + turned)[:, self._view]
        return placed


def _bar(centre: Array, half: Array, length: float, radius: float, round_ends: bool) -> Array:
    """The ends (2, 2) of a bar about a centre (2,); if seen obliquely or end-on, its outline (k, 2).

    `half` (2,) is the projection of half the bar, which has the given length. Round ends are half spheres
    beyond it.
    """
    seen = np.hypot(*half)
    if seen > (1 - EDGE_ON) * length:
        return np.array([centre - half, centre + half])
    angle, deep = np.arctan2(half[1], half[0]), 1.0 if round_ends else np.sqrt(1 - (seen / length) ** 2)
    edge = np.stack([seen + deep * radius * np.cos(HALF_TURN), radius * np.sin(HALF_TURN)], axis=1)
    turn = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    return centre + np.concatenate([edge, -edge]) @ turn


def _outline(centre: Array, halves: Array) -> Array:
    """Corners (4 or 6, 2) about a centre (2,) of a box; `halves` (3, 2) are its projected half edges."""
    sizes = np.hypot(*halves.T)
    halves = halves[sizes > EDGE_ON * sizes.max()]
    halves = np.where(halves[:, 1:] < 0, -halves, halves) + 0.0  # upwards; -0.0 would have another angle
    sides = halves[np.argsort(np.arctan2(halves[:, 1], halves[:, 0]))]
    around = np.cumsum(2 * np.concatenate([sides, -sides[:-1]]), axis=0)
    return centre - sides.sum(axis=0) + np.concatenate([np.zeros((1, 2)), around])
