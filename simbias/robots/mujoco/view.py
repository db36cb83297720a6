"""The plane for viewing a robot: its plane of motion, if it is planar."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from simbias.core.records import Indices
from simbias.robots.mujoco.parameters import mujoco

View = Literal["xz", "yz", "xy"]
POSES, SEED = 20, 0  # random poses, to find the axis along which nothing moves
REACH = 0.5  # rad or m, of joints without limits


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
