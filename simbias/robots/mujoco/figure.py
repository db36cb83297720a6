"""A drawing of a robot's MuJoCo model: a stick figure of its geoms, or as MuJoCo renders it."""

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
from simbias.robots.mujoco.rendering import Image, NoRendererError, Rendering
from simbias.robots.mujoco.view import View, axes_of, solid_geoms, view_of


@dataclass(frozen=True)
class FigureFile:
    """Source of a drawing: a file, as `simbias.robots.mujoco.mjcf.Mechanism` takes it."""

    file: ConfigFile
    joints: list[str] | None = None
    actuators: list[str] | None = None
    view: View | None = None  # the plane that is seen; None: the one in which the robot moves
    rendered: bool | None = None  # by MuJoCo, where OpenGL can run; None: if the stick figure lacks a geom


class Figure:
    """Spheres are discs, capsules and cylinders are bars, boxes are polygons; other geoms are left out.

    With these, MuJoCo renders it, where it can.

    Raises
    ------
    ValueError
        If the file cannot be read or does not go with the task.
    """

    def __init__(self, task: Task, source: FigureFile) -> None:
        self._robot = Mechanism(task, source.file, source.joints, source.actuators)
        self.source_files = self._robot.source_files
        view = source.view or view_of(self._robot.model)
        self._view = axes_of(view)
        self._data: Any = mujoco().MjData(self._robot.model)
        self.thickness: dict[str, float] = {}  # of each part, in m
        self._ends: dict[str, tuple[int, Array]] = {}  # a geom, and points (k, 3) in its frame
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
        """Rendered image at the state x (n,); None where a stick figure is drawn."""
        if self._rendering is not None:
            try:
                return self._rendering.image(x)
            except NoRendererError as error:
                warnings.warn(f"a stick figure is drawn: {error}", stacklevel=2)
                self._rendering = None
        return None

    def _local(self, index: int) -> Array | None:
        """The points (k, 3) of a geom in its own frame; None if it is not drawn."""
        kind = mujoco().mjtGeom(int(self._robot.model.geom_type[index])).name
        size = self._robot.model.geom_size[index]
        if kind == "mjGEOM_SPHERE":
            return np.zeros((1, 3))
        if kind in ("mjGEOM_CAPSULE", "mjGEOM_CYLINDER"):
            return np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]])
        if kind == "mjGEOM_BOX":
            first, second = self._view
            corners = np.zeros((4, 3))
            corners[:, first] = size[first] * np.array([-1, 1, 1, -1])
            corners[:, second] = size[second] * np.array([-1, -1, 1, 1])
            return corners
        return None

    def points(self, x: Array) -> dict[str, Array]:
        """The points (k, 2) of every part in m, at the state x (n,)."""
        model, data = self._robot.model, self._data
        data.qpos[:] = self._robot.physics(x[None])[0, 1 : 1 + model.nq]
        mujoco().mj_kinematics(model, data)
        return {
            name: (data.geom_xpos[geom] + points @ data.geom_xmat[geom].reshape(3, 3).T)[:, self._view]
            for name, (geom, points) in self._ends.items()
        }
