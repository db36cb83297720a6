"""Views of a robot's model, and MuJoCo's rendering of it: orthographic, without a window."""

from __future__ import annotations

from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from simbias.core.records import Array, Indices
from simbias.robots.mujoco.mjcf import Mechanism
from simbias.robots.mujoco.parameters import mujoco

View = Literal["xz", "yz", "xy"]
POSES, SEED = 20, 0  # random poses, to find the axis along which nothing moves
REACH = 0.5  # rad or m, of joints without limits
PIXELS = 480  # along each side of an image
MARGIN = 0.05  # of the robot's size, around it
# Azimuth and elevation of the camera in degrees.
ANGLES: dict[View, tuple[float, float]] = {"xz": (90.0, 0.0), "yz": (180.0, 0.0), "xy": (90.0, -90.0)}


class Image(NamedTuple):
    """An image to scale."""

    pixels: Array  # (k, l, 4): red, green, blue and opacity, each from 0 to 1, the upper row first
    extent: tuple[float, float, float, float]  # left, right, bottom and top in m


class NoRendererError(RuntimeError):
    """OpenGL cannot run here without a screen."""


class Rendering:
    """Images of a robot, to scale; planes are left out."""

    def __init__(self, robot: Mechanism, view: View) -> None:
        self._robot = robot.with_values({})  # a copy, as its visual settings are changed
        self._axes = axes_of(view)
        model, camera = self._robot.model, mujoco().MjvCamera()
        self._solid = solid_geoms(model)
        model.geom_rgba[np.setdiff1d(np.arange(model.ngeom), self._solid), 3] = 0.0
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.6
        camera.orthographic, (camera.azimuth, camera.elevation) = 1, ANGLES[view]
        self._camera, self._data = camera, mujoco().MjData(model)

    @cached_property
    def _context(self) -> tuple[Any, Any, Any]:
        """The OpenGL context, the renderer, and the scene."""
        try:
            from mujoco.egl import GLContext  # MuJoCo makes its own choice on import

            context = GLContext(PIXELS, PIXELS)
            context.make_current()
            drawing = mujoco().MjrContext(self._robot.model, int(mujoco().mjtFontScale.mjFONTSCALE_100))
        except Exception as error:  # of EGL, PyOpenGL or MuJoCo, of many types
            raise NoRendererError("OpenGL cannot run here without a screen (EGL)") from error
        return context, drawing, mujoco().MjvScene(self._robot.model, maxgeom=10_000)

    def image(self, x: Array) -> Image:
        """The robot at the state x (n,); NoRendererError if it cannot be rendered here."""
        context, drawing, scene = self._context
        engine, model, data = mujoco(), self._robot.model, self._data
        data.qpos[:] = self._robot.physics(x[None])[0, 1 : 1 + model.nq]
        engine.mj_forward(model, data)
        centres, radii = data.geom_xpos[self._solid], model.geom_rbound[self._solid, None]
        low, high = (centres - radii).min(axis=0), (centres + radii).max(axis=0)
        middle, half = (low + high) / 2, (0.5 + MARGIN) * float((high - low)[self._axes].max())
        self._camera.lookat, self._camera.distance = middle, 10 * float(np.linalg.norm(high - low))
        model.vis.global_.fovy = 2 * half  # the visible height in m, without perspective
        context.make_current()
        category = int(engine.mjtCatBit.mjCAT_ALL)
        engine.mjv_updateScene(
            model, data, engine.MjvOption(), engine.MjvPerturb(), self._camera, category, scene
        )
        rgb, depth = np.empty((PIXELS, PIXELS, 3), np.uint8), np.empty((PIXELS, PIXELS), np.float32)
        where = engine.MjrRect(0, 0, PIXELS, PIXELS)
        engine.mjr_render(where, scene, drawing)
        engine.mjr_readPixels(rgb, depth, where, drawing)
        opacity = (depth < depth.max()) if depth.max() > depth.min() else np.ones_like(depth)
        pixels = np.dstack([rgb / 255.0, opacity])[::-1]  # OpenGL's rows begin at the bottom
        return _cropped(pixels, middle[self._axes], half)


def _cropped(pixels: Array, middle: Array, half: float) -> Image:
    """Crop a square image about a middle (2,), twice `half` m wide, to its visible pixels."""
    rows, columns = (np.flatnonzero(pixels[..., 3].any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        rows = columns = np.arange(len(pixels))
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    metres = 2 * half / len(pixels)
    x, y = float(middle[0]) - half, float(middle[1]) + half
    extent = (x + metres * left, x + metres * right, y - metres * bottom, y - metres * top)
    return Image(pixels[top:bottom, left:right], extent)


def view_of(model: Any) -> View:
    """The plane with the least motion of solid geoms perpendicular to it; if tied, xz, from the side."""
    engine, data, rng = mujoco(), mujoco().MjData(model), np.random.default_rng(SEED)
    low, high = np.where(model.jnt_limited[:, None], model.jnt_range, [-REACH, REACH]).T
    solid, points = solid_geoms(model), []
    places = model.jnt_qposadr
    hinges = model.jnt_type >= int(engine.mjtJoint.mjJNT_SLIDE)  # and slides; others stay fixed
    for _ in range(POSES):
        data.qpos[places[hinges]] = rng.uniform(low, high)[hinges]
        engine.mj_kinematics(model, data)
        ends = model.geom_rbound[solid, None, None] * data.geom_xmat[solid].reshape(-1, 3, 3)
        points.append(data.geom_xpos[solid, :, None] + ends)  # (geoms, 3, 3) ends of each geom's axes
    across = np.ptp(points, axis=0).max(axis=(0, 2), initial=0.0).round(9)  # (3,) along x, y and z
    views: dict[View, int] = {"xz": 1, "yz": 0, "xy": 2}  # each with the axis of the line of sight
    return min(views, key=lambda view: float(across[views[view]]))


def axes_of(view: View) -> list[int]:
    """The indices of a view's two axes."""
    return ["xyz".index(axis) for axis in view]


def solid_geoms(model: Any) -> Indices:
    """The indices of all geoms except planes, which are infinite."""
    return np.flatnonzero(model.geom_type != int(mujoco().mjtGeom.mjGEOM_PLANE))
