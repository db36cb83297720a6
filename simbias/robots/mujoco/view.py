"""The plane in which a robot is seen: the one in which it moves, if it is flat."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from simbias.core.records import Indices
from simbias.robots.mujoco.parameters import mujoco

View = Literal["xz", "yz", "xy"]
POSES, SEED = 20, 0  # drawn at random, to see along which axis nothing moves
REACH = 0.5  # rad or m, of joints without limits


def view_of(model: Any) -> View:
    """The plane across which the solid geoms move least; where several are equal, xz, from the side."""
    engine, data, rng = mujoco(), mujoco().MjData(model), np.random.default_rng(SEED)
    low, high = np.where(model.jnt_limited[:, None], model.jnt_range, [-REACH, REACH]).T
    solid, points = solid_geoms(model), []
    places = model.jnt_qposadr
    hinges = model.jnt_type >= int(engine.mjtJoint.mjJNT_SLIDE)  # and slides; balls and free joints stay
    for _ in range(POSES):
        data.qpos[places[hinges]] = rng.uniform(low, high)[hinges]
        engine.mj_kinematics(model, data)
        ends = model.geom_rbound[solid, None, None] * data.geom_xmat[solid].reshape(-1, 3, 3)
        points.append(data.geom_xpos[solid, :, None] + ends)  # (geoms, 3, 3) ends of each geom's own axes
    across = np.ptp(points, axis=0).max(axis=(0, 2), initial=0.0).round(9)  # (3,) along x, y and z
    views: dict[View, int] = {"xz": 1, "yz": 0, "xy": 2}  # and the axis along which one looks
    return min(views, key=lambda view: float(across[views[view]]))


def axes_of(view: View) -> list[int]:
    """The indices of a view's two axes."""
    return ["xyz".index(axis) for axis in view]


def solid_geoms(model: Any) -> Indices:
    """The indices of all geoms but planes, which are endless."""
    return np.flatnonzero(model.geom_type != int(mujoco().mjtGeom.mjGEOM_PLANE))
