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

# By name, `*` for any: `{"*.mass": 1.3}`.
Values = dict[str, Annotated[float, Field(ge=0, le=1e6)]]
Factors = dict[str, Annotated[float, Field(gt=0, le=1e3)]]
UNNAMED = ("", "world")  # what has no parameters


@cache
def mujoco() -> Any:
    """The library; it warns of unstable simulations in the log, not in a file of the current folder."""
    engine = library("mujoco", "MuJoCo", "mujoco")
    engine.set_mju_user_warning(logging.getLogger(__name__).info)
    return engine


class Quantity(NamedTuple):
    """A physical quantity of each element of a kind, in a compiled model."""

    element: str  # body, joint, geom or actuator
    unit: str
    get: Callable[[Any, int], float]  # of a model and an element's index
    put: Callable[[Any, int, float], None]


def _put_gain(model: Any, i: int, value: float) -> None:
    """A motor that gives so much of the force that its file says."""
    model.actuator_gear[i] *= value


def _put_mass(model: Any, i: int, value: float) -> None:
    """A body of another mass and the same shape: its inertia grows with it."""
    if model.body_mass[i]:
        model.body_inertia[i] *= value / model.body_mass[i]
    model.body_mass[i] = value


def _put_inertia(model: Any, i: int, value: float) -> None:
    """A body whose largest principal moment of inertia is another, the others in proportion."""
    largest = model.body_inertia[i].max()
    model.body_inertia[i] = value if largest == 0 else model.body_inertia[i] * (value / largest)


def _put_size(model: Any, i: int, value: float) -> None:
    """A body with all that hangs from it at another distance: of another size and the same mass."""
    own = np.flatnonzero(model.geom_bodyid == i)
    sites = np.flatnonzero(model.site_bodyid == i)
    children = np.flatnonzero(model.body_parentid == i)
    children = children[children != i]
    model.body_ipos[i] *= value
    model.body_inertia[i] *= value**2
    model.body_pos[children] *= value
    model.geom_pos[own] *= value
    model.geom_size[own] *= value
    model.geom_rbound[own] *= value
    model.geom_aabb[own] *= value
    model.site_pos[sites] *= value
    first = model.body_bvhadr[i]
    model.bvh_aabb[first : first + model.body_bvhnum[i]] *= value


def _field(element: str, unit: str, name: str, *column: int) -> Quantity:
    """A quantity that stands in an array of the model."""

    def get(model: Any, i: int) -> float:
        return float(getattr(model, name)[(i, *column)])

    def put(model: Any, i: int, value: float) -> None:
        getattr(model, name)[(i, *column)] = value

    return Quantity(element, unit, get, put)


def _of_joint(unit: str, name: str) -> Quantity:
    """A quantity of a hinge or slide joint's degree of freedom."""

    def get(model: Any, i: int) -> float:
        return float(getattr(model, name)[model.jnt_dofadr[i]])

    def put(model: Any, i: int, value: float) -> None:
        getattr(model, name)[model.jnt_dofadr[i]] = value

    return Quantity("joint", unit, get, put)


QUANTITIES: Mapping[str, Quantity] = {
    "mass": Quantity("body", "kg", lambda model, i: float(model.body_mass[i]), _put_mass),
    "size": Quantity("body", "1", lambda model, i: 1.0, _put_size),
    "inertia": Quantity("body", "kg m^2", lambda model, i: float(model.body_inertia[i].max()), _put_inertia),
    "damping": _of_joint("N m s/rad or N s/m", "dof_damping"),
    "friction": _of_joint("N m or N", "dof_frictionloss"),
    "armature": _of_joint("kg m^2 or kg", "dof_armature"),
    "stiffness": _field("joint", "N m/rad or N/m", "jnt_stiffness"),
    "contact_friction": _field("geom", "1", "geom_friction", 0),
    "gain": Quantity("actuator", "1", lambda model, i: 1.0, _put_gain),
}


def values_of(model: Any, pattern: str) -> dict[str, float]:
    """The parameters whose names fit a pattern, as `pole.mass` or `*.mass`, and their values.

    Raises
    ------
    ValueError
        If there is none.
    """
    found = {
        f"{name}.{kind}": quantity.get(model, index)
        for kind, quantity in QUANTITIES.items()
        for index, name in enumerate(all_names(model, quantity.element))
        if name not in UNNAMED and fnmatchcase(f"{name}.{kind}", pattern)
    }
    if not found:
        kinds = ", ".join(f"{quantity.element}.{kind}" for kind, quantity in QUANTITIES.items())
        names = ", ".join(name for each in ("body", "joint", "actuator") for name in names_of(model, each))
        raise ValueError(f"no parameter is called {quote(pattern)}; there is {kinds}; of {names}")
    return found


def put_values(model: Any, values: Mapping[str, float]) -> None:
    """Set parameters of a compiled model, by name, in their units; masses first, inertias grow with them."""
    for kind, quantity in QUANTITIES.items():
        names = all_names(model, quantity.element)
        for name, value in values.items():
            element, _, own = name.rpartition(".")
            if own == kind:
                quantity.put(model, names.index(element), value)
    engine = mujoco()
    engine.mj_setConst(model, engine.MjData(model))


def changes(model: Any, values: Values, factors: Factors) -> dict[str, float]:
    """What is set, and what is multiplied, as values by name.

    Raises
    ------
    ValueError
        If no parameter has such a name.
    """
    changed = {name: value for pattern, value in values.items() for name in values_of(model, pattern)}
    for pattern, factor in factors.items():
        changed |= {name: factor * value for name, value in values_of(model, pattern).items()}
    return changed


def all_names(model: Any, element: str) -> list[str]:
    """The names of all bodies, joints, geoms or actuators, in their order; "" where one has none."""
    count = getattr(model, {"body": "nbody", "joint": "njnt", "geom": "ngeom", "actuator": "nu"}[element])
    return [getattr(model, element)(index).name for index in range(count)]


def names_of(model: Any, element: str) -> list[str]:
    """Those that have a name, but for the world."""
    return [name for name in all_names(model, element) if name not in UNNAMED]
