"""A robot's MuJoCo model: a file whose joints are a task's states, whose actuators are its inputs.

Its physical parameters have names: `pole.mass` is the mass of the body `pole`. See `QUANTITIES`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cache
from importlib.util import find_spec
from math import ceil
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from simbias.interfaces import Task
from simbias.messages import quote, words
from simbias.records import Array

# By name, `*` for any: `{"*.mass": 1.3}`.
Values = dict[str, Annotated[float, Field(ge=0, le=1e6)]]
Factors = dict[str, Annotated[float, Field(gt=0, le=1e3)]]
UNNAMED = ("", "world")  # what has no parameters
EXTRA = "pip install 'simbias[mujoco]'"


@cache
def mujoco() -> Any:
    """The library.

    Raises
    ------
    ValueError
        If it is not installed; the line says how to install it.
    """
    try:
        import mujoco
    except ImportError as error:
        raise ValueError(f"MuJoCo is not installed ({words(error)}): {EXTRA}") from error
    return mujoco


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


class Mechanism:
    """A MuJoCo model whose state and input are those of a task.

    States are the positions of the joints, then their velocities. Inputs are the forces and torques of
    motors; of other actuators they are their controls. A frame is a whole number of the engine's steps, which
    are as long as the file says, or a little shorter.

    Parameters
    ----------
    task
        Its states, inputs and time step.
    file
        MJCF or URDF, relative to the folder where simbias is started; or `package:path` of a file that is
        installed with a package.
    joints, actuators
        Their names, in the order of states and inputs; by default all of the file. An actuator may be a
        joint's name, as in a URDF, which knows none: a motor is put there.

    Raises
    ------
    ValueError
        If MuJoCo is not installed, the file cannot be read, or does not go with the task.
    """

    def __init__(
        self,
        task: Task,
        file: str,
        joints: Sequence[str] | None = None,
        actuators: Sequence[str] | None = None,
    ) -> None:
        engine = mujoco()
        model = self.model = _read(file, actuators or ())
        kinds = {name: int(model.joint(name).type[0]) for name in _names(model, "joint")}
        joints = list(kinds) if joints is None else list(joints)
        actuators = _names(model, "actuator") if actuators is None else list(actuators)
        _check(joints, kinds, "joints", file)
        _check(actuators, _names(model, "actuator"), "actuators", file)
        allowed = (int(engine.mjtJoint.mjJNT_HINGE), int(engine.mjtJoint.mjJNT_SLIDE))
        for name, kind in kinds.items():
            if kind not in allowed or name not in joints:
                raise ValueError(f"{file}: joint {name}: all joints have to be states, hinges or slides")
        if len(task.states) != 2 * len(joints):
            raise ValueError(
                f"the task has {len(task.states)} states; positions and velocities of the joints "
                f"{', '.join(joints)} are {2 * len(joints)}"
            )
        if len(task.inputs) != len(actuators):
            raise ValueError(f"the task has {len(task.inputs)} inputs; {file} has actuators {actuators}")
        self.substeps = ceil(task.time_step / model.opt.timestep - 1e-6)
        model.opt.timestep = task.time_step / self.substeps
        model.opt.disableflags |= engine.mjtDisableBit.mjDSBL_AUTORESET  # what blows up is no start
        self._positions = np.array([model.joint(name).qposadr[0] for name in joints])
        self._velocities = np.array([model.joint(name).dofadr[0] for name in joints])
        self._actuators = np.array([model.actuator(name).id for name in actuators])
        self._units = np.array([_unit(engine, model, i) for i in self._actuators])
        for name, index, unit, limit in zip(
            actuators, self._actuators, self._units, task.input_limit, strict=True
        ):
            most = _reach(engine, model, index, unit)
            if limit > most * (1 + 1e-9):
                raise ValueError(f"the task's input may be {limit:g}; the actuator {name} gives {most:g}")

    @property
    def hidden(self) -> list[str]:
        """Actuators with a state of their own, which the task's states do not show."""
        return [self.model.actuator(i).name for i in np.flatnonzero(self.model.actuator_dyntype)]

    def with_values(self, values: Mapping[str, float]) -> Mechanism:
        """The mechanism with other values of its parameters, by name, in their units."""
        changed = copy.copy(self)
        changed.model = copy.copy(self.model)
        put_values(changed.model, values)
        return changed

    def physics(self, x: Array) -> Array:
        """MuJoCo's full states (k, .) at states x (k, n)."""
        model, joints = self.model, len(self._positions)
        size = mujoco().mj_stateSize(model, mujoco().mjtState.mjSTATE_FULLPHYSICS)
        full = np.zeros((len(x), size))  # time, positions, velocities, what else there is
        full[:, 1 + self._positions] = x[:, :joints]
        full[:, 1 + model.nq + self._velocities] = x[:, joints:]
        return full

    def states(self, full: Array) -> Array:
        """States x (k, n) of MuJoCo's full states (k, .)."""
        positions, velocities = 1 + self._positions, 1 + self.model.nq + self._velocities
        return np.concatenate([full[:, positions], full[:, velocities]], axis=1)

    def controls(self, u: Array) -> Array:
        """Controls (k, .) of inputs u (k, m)."""
        controls = np.zeros((len(u), self.model.nu))
        controls[:, self._actuators] = u / self._units
        return controls


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
        for index, name in enumerate(_all_names(model, quantity.element))
        if name not in UNNAMED and fnmatchcase(f"{name}.{kind}", pattern)
    }
    if not found:
        kinds = ", ".join(f"{quantity.element}.{kind}" for kind, quantity in QUANTITIES.items())
        names = ", ".join(name for each in ("body", "joint", "actuator") for name in _names(model, each))
        raise ValueError(f"no parameter is called {quote(pattern)}; there is {kinds}; of {names}")
    return found


def put_values(model: Any, values: Mapping[str, float]) -> None:
    """Set parameters of a compiled model, by name, in their units; masses first, inertias grow with them."""
    for kind, quantity in QUANTITIES.items():
        names = _all_names(model, quantity.element)
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


def _read(file: str, actuators: Sequence[str]) -> Any:
    """The compiled model of a file, with motors at joints that are named as actuators."""
    engine = mujoco()
    path = _path(file)
    if not path.is_file():
        raise ValueError(f"no such file: {path}")
    try:
        spec = engine.MjSpec.from_file(str(path))
        known = {actuator.name for actuator in spec.actuators}
        for name in actuators:
            if name not in known and any(joint.name == name for joint in spec.joints):
                spec.add_actuator(name=name, target=name, trntype=engine.mjtTrn.mjTRN_JOINT)
        return spec.compile()
    except Exception as error:  # MuJoCo's, of many types
        raise ValueError(f"{file}: {words(error)}") from error


def _path(file: str) -> Path:
    """Where a file is; `package:path` lies in a package."""
    package, colon, inside = file.partition(":")
    if not colon or not package.isidentifier():
        return Path(file).expanduser()
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ValueError(f"{file}: the package {package} is not installed: pip install {package}")
    return Path(spec.submodule_search_locations[0]) / inside


def _check(wanted: Sequence[str], known: Mapping[str, Any] | Sequence[str], key: str, file: str) -> None:
    """Names that a file has to have."""
    for name in wanted:
        if name not in known:
            raise ValueError(f"{key}: {file} has no {quote(name)}; it has {', '.join(known)}")


def _unit(engine: Any, model: Any, i: int) -> float:
    """What a control of 1 gives, in the unit of the input: the force of a motor, else 1."""
    motor = (
        model.actuator_gaintype[i] == engine.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[i] == engine.mjtBias.mjBIAS_NONE
    )
    return float(model.actuator_gear[i, 0] * model.actuator_gainprm[i, 0]) if motor else 1.0


def _reach(engine: Any, model: Any, i: int, unit: float) -> float:
    """The largest input of an actuator, as its file limits its control, its force, and that on its joint."""
    ranges = []
    if model.actuator_ctrllimited[i]:
        ranges.append(abs(unit) * model.actuator_ctrlrange[i])
    if model.actuator_forcelimited[i]:
        ranges.append(abs(model.actuator_gear[i, 0]) * model.actuator_forcerange[i])
    joint = model.actuator_trnid[i, 0]
    if model.actuator_trntype[i] == engine.mjtTrn.mjTRN_JOINT and model.jnt_actfrclimited[joint]:
        ranges.append(model.jnt_actfrcrange[joint])
    return float(min((min(-low, high) for low, high in ranges), default=np.inf))


def _all_names(model: Any, element: str) -> list[str]:
    """The names of all bodies, joints, geoms or actuators, in their order; "" where one has none."""
    count = getattr(model, {"body": "nbody", "joint": "njnt", "geom": "ngeom", "actuator": "nu"}[element])
    return [getattr(model, element)(index).name for index in range(count)]


def _names(model: Any, element: str) -> list[str]:
    """Those that have a name, but for the world."""
    return [name for name in _all_names(model, element) if name not in UNNAMED]
