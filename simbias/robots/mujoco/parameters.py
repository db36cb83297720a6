"""The physical parameters of a MuJoCo model, by name: `pole.mass` is the mass of the body `pole`."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase
from functools import cache
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from simbias.core.extras import library
from simbias.core.messages import quote
from simbias.core.records import Array

# By name, `*` for any: `{"*.mass": 1.3}`.
Values = dict[str, Annotated[float, Field(ge=0, le=1e6)]]
Factors = dict[str, Annotated[float, Field(gt=0, le=1e3)]]
UNNAMED = ("", "world")  # names of elements without parameters
RELATIVE = (".size", ".gain")  # endings of parameters that are factors on a compiled model's values


@cache
def mujoco() -> Any:
    """The MuJoCo library, with warnings of unstable simulations in the log, not in a file."""
    engine = library("mujoco", "MuJoCo", "mujoco")
    engine.set_mju_user_warning(logging.getLogger(__name__).info)
    return engine


class ModelQuantity(NamedTuple):
    """A physical quantity of every element of a kind, in a compiled model."""

    element: str  # body, joint, geom or actuator
    unit: str
    get: Callable[[Any, str], float]  # from a model and an element's name
    put: Callable[[Any, str, float], None]


def _array(element: str, unit: str, field: str) -> ModelQuantity:
    """A quantity in a field such as `model.joint("hinge").damping`: all axes of a joint, else the first."""

    def values(model: Any, name: str) -> Array:
        return getattr(getattr(model, element)(name), field)

    def put(model: Any, name: str, value: float) -> None:
        values(model, name)[: None if element == "joint" else 1] = value

    return ModelQuantity(element, unit, lambda model, name: float(values(model, name)[0]), put)


def _put_mass(model: Any, name: str, value: float) -> None:
    """Scale a body's mass and inertia together: the same shape with another density."""
    body = model.body(name)
    if body.mass[0]:
        body.inertia *= value / body.mass[0]
    body.mass[0] = value


def _put_inertia(model: Any, name: str, value: float) -> None:
    """Set the largest principal moment of inertia of a body, and scale the others in proportion."""
    inertia = model.body(name).inertia
    inertia[:] = value if not inertia.any() else inertia * (value / inertia.max())


def _put_size(model: Any, name: str, value: float) -> None:
    """Scale a body's size at the same mass, including offsets of attached bodies; joints stay together."""
    body = model.body(name).id
    body_bounds = model.body_bvhadr[body] + np.arange(model.body_bvhnum[body])
    geoms, sites = model.geom_bodyid == body, model.site_bodyid == body
    children = (model.body_parentid == body) & (np.arange(model.nbody) != body)
    joints = _first_joints(model) + model.body_pos
    joints[children] *= value
    model.body_inertia[body] *= value**2
    for lengths, rows in (
        (model.body_ipos, body),
        (model.jnt_pos, model.jnt_bodyid == body),
        (model.site_pos, sites),
        (model.geom_pos, geoms),
        (model.geom_size, geoms),
        (model.geom_rbound, geoms),
        (model.geom_aabb, geoms),
        (model.bvh_aabb, body_bounds),
    ):
        lengths[rows] *= value
    children[body] = True
    model.body_pos[children] = (joints - _first_joints(model))[children]


def _first_joints(model: Any) -> Array:
    """Position of each body's first joint, relative to the body's origin, in the parent's axes (nbody, 3)."""
    joints = np.zeros((model.nbody, 3))
    for body in np.flatnonzero(model.body_jntnum):
        position = model.jnt_pos[model.body_jntadr[body]]
        mujoco().mju_rotVecQuat(joints[body], position, model.body_quat[body])
    return joints


def _put_gain(model: Any, name: str, value: float) -> None:
    """Scale an actuator's force by this factor."""
    actuator = model.actuator(name)
    if actuator.biastype[0] != mujoco().mjtBias.mjBIAS_AFFINE:
        actuator.gear[:] *= value
        return
    for forces in (actuator.gainprm, actuator.biasprm, actuator.forcerange):  # a gear also scales lengths
        forces[:] *= value


# Written into the compiled model: via MjSpec, a draw with one mesh takes 80 ms instead of 0.2 ms.
QUANTITIES: Mapping[str, ModelQuantity] = {
    "mass": _array("body", "kg", "mass")._replace(put=_put_mass),
    "size": ModelQuantity("body", "1", lambda model, name: 1.0, _put_size),
    "inertia": ModelQuantity(
        "body", "kg m^2", lambda model, name: float(model.body(name).inertia.max()), _put_inertia
    ),
    "damping": _array("joint", "N m s/rad or N s/m", "damping"),
    "friction": _array("joint", "N m or N", "frictionloss"),
    "armature": _array("joint", "kg m^2 or kg", "armature"),
    "stiffness": _array("joint", "N m/rad or N/m", "stiffness"),
    "contact_friction": _array("geom", "1", "friction"),
    "gain": ModelQuantity("actuator", "1", lambda model, name: 1.0, _put_gain),
}


def values_of(model: Any, pattern: str) -> dict[str, float]:
    """The parameters whose names match a pattern, such as `*.mass`, and their values; ValueError if none."""
    found = {
        f"{name}.{kind}": quantity.get(model, name)
        for kind, quantity in QUANTITIES.items()
        for name in names_of(model, quantity.element)
        if fnmatchcase(f"{name}.{kind}", pattern)
    }
    if not found:
        kinds = ", ".join(f"{quantity.element}.{kind}" for kind, quantity in QUANTITIES.items())
        names = ", ".join(name for each in ("body", "joint", "actuator") for name in names_of(model, each))
        raise ValueError(f"no parameter is called {quote(pattern)}; available: {kinds}, for {names}")
    return found


def unit_of(model: Any, name: str) -> str:
    """The unit of a parameter; for a joint, in terms of angles or, if it slides, of lengths."""
    element, _, kind = name.rpartition(".")
    turning, _, sliding = QUANTITIES[kind].unit.partition(" or ")
    slides = bool(sliding) and model.joint(element).type[0] == mujoco().mjtJoint.mjJNT_SLIDE
    return sliding if slides else turning


def put_values(model: Any, values: Mapping[str, float], data: Any = None) -> None:
    """Set parameters of a compiled model, by name, in their units; masses first, as inertias scale with them.

    `RELATIVE` ones are factors on the model's values.

    The engine computes derived quantities in data for a model of the same sizes; allocating data takes 0.4
    ms.
    """
    for kind, quantity in QUANTITIES.items():
        for name, value in values.items():
            element, _, own = name.rpartition(".")
            if own == kind:
                quantity.put(model, element, value)
    engine = mujoco()
    engine.mj_setConst(model, engine.MjData(model) if data is None else data)


def changes(model: Any, values: Values, factors: Factors) -> dict[str, float]:
    """Values by name of the parameters that are set or multiplied.

    If several values match a name, the last one counts; all matching factors multiply it. ValueError if no
    parameter has such a name.
    """
    changed = {name: value for pattern, value in values.items() for name in values_of(model, pattern)}
    for pattern, factor in factors.items():
        for name, value in values_of(model, pattern).items():
            changed[name] = factor * changed.get(name, value)
    return changed


def names_of(model: Any, element: str) -> list[str]:
    """Names of all named bodies (except the world), joints, geoms or actuators, in order."""
    count = getattr(model, {"body": "nbody", "joint": "njnt", "geom": "ngeom", "actuator": "nu"}[element])
    names = [getattr(model, element)(index).name for index in range(count)]
    return [name for name in names if name not in UNNAMED]
