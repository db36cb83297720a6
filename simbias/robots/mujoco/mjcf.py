"""A robot's MuJoCo model: a file whose joints are a task's states, whose actuators are its inputs."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from simbias.core import Task
from simbias.core.messages import quote, words
from simbias.core.records import Array
from simbias.robots.mujoco.parameters import mujoco, names_of, put_values


class Mechanism:
    """A MuJoCo model whose state and input are those of a task.

    States are the positions of the joints, then their velocities. Inputs are the forces and torques of
    motors, of those at a site along (else about) the axis of their gear; of other actuators they are their
    controls. A frame is a whole number of the engine's steps, which are as long as the file says, or a
    little shorter.

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
        self._file, self._added = file, actuators or ()
        model = self.model = _read(file, self._added)
        kinds = {name: int(model.joint(name).type[0]) for name in names_of(model, "joint")}
        joints = list(kinds) if joints is None else list(joints)
        actuators = names_of(model, "actuator") if actuators is None else list(actuators)
        _check(joints, kinds, "joints", file)
        _check(actuators, names_of(model, "actuator"), "actuators", file)
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
        if not (model.geom_contype.any() and model.geom_conaffinity.any()) and not model.npair:
            model.opt.disableflags |= engine.mjtDisableBit.mjDSBL_CONTACT  # not to look for what cannot touch
        positions = [model.joint(name).qposadr[0] for name in joints]
        velocities = [model.nq + model.joint(name).dofadr[0] for name in joints]
        self.state_places = 1 + np.array([*positions, *velocities])  # (n,) in full states, after the time
        self.control_places = np.array([model.actuator(name).id for name in actuators])  # (m,) in controls
        self.units = np.array([_unit(engine, model, i) for i in self.control_places])  # (m,) of controls
        for name, index, unit, limit in zip(
            actuators, self.control_places, self.units, task.input_limit, strict=True
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

    def text(self) -> str:
        """The mechanism as MJCF; inertias are written out, files of meshes and textures as absolute paths."""
        engine, spec, model = mujoco(), _spec(_path(self._file), self._added), self.model
        spec.compile()
        spec.compiler.inertiafromgeom = engine.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
        for body in spec.bodies[1:]:
            i, body.explicitinertial, body.fullinertia = body.id, True, [np.nan] * 6
            body.mass, body.inertia = model.body_mass[i], model.body_inertia[i]
            body.ipos, body.iquat = model.body_ipos[i], model.body_iquat[i]
        spec.compile()
        spec.copy_back(model)
        spec.stat.meaninertia = np.nan  # which copying sets; it affects nothing, and a file may not say it
        for folder in ("meshdir", "texturedir"):
            own = _path(self._file).parent / (getattr(spec.compiler, folder) or "")
            setattr(spec.compiler, folder, str(own.resolve()))
        return str(spec.to_xml())

    def physics(self, x: Array) -> Array:
        """MuJoCo's full states (k, .) at states x (k, n)."""
        size = mujoco().mj_stateSize(self.model, mujoco().mjtState.mjSTATE_FULLPHYSICS)
        full = np.zeros((len(x), size))  # time, positions, velocities, what else there is
        full[:, self.state_places] = x
        return full

    def states(self, full: Array) -> Array:
        """States x (k, n) of MuJoCo's full states (k, .)."""
        return full[:, self.state_places]

    def controls(self, u: Array) -> Array:
        """Controls (k, .) of inputs u (k, m)."""
        controls = np.zeros((len(u), self.model.nu))
        controls[:, self.control_places] = u / self.units
        return controls


def _read(file: str, actuators: Sequence[str]) -> Any:
    """The compiled model of a file, with motors at joints that are named as actuators."""
    if not (path := _path(file)).is_file():
        raise ValueError(f"no such file: {path}")
    try:
        return _spec(path, actuators).compile()
    except Exception as error:  # MuJoCo's, of many types
        raise ValueError(f"{file}: {words(error)}") from error


def _spec(path: Path, actuators: Sequence[str]) -> Any:
    """The model that a file specifies, with these motors."""
    engine = mujoco()
    spec = engine.MjSpec.from_file(str(path))
    known = {actuator.name for actuator in spec.actuators}
    for name in actuators:
        if name not in known and any(joint.name == name for joint in spec.joints):
            spec.add_actuator(name=name, target=name, trntype=engine.mjtTrn.mjTRN_JOINT)
    return spec


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
    return float(_gear(engine, model, i) * model.actuator_gainprm[i, 0]) if motor else 1.0


def _gear(engine: Any, model: Any, i: int) -> float:
    """Force of an actuator at a site along the axis of its six gears, or torque about it; else the gear."""
    gear = model.actuator_gear[i]
    if model.actuator_trntype[i] != engine.mjtTrn.mjTRN_SITE:
        return float(gear[0])
    return float(np.linalg.norm(gear[:3]) or np.linalg.norm(gear[3:]))


def _reach(engine: Any, model: Any, i: int, unit: float) -> float:
    """The largest input of an actuator, as its file limits its control, its force, and that on its joint."""
    ranges = []
    if model.actuator_ctrllimited[i]:
        ranges.append(abs(unit) * model.actuator_ctrlrange[i])
    if model.actuator_forcelimited[i]:
        ranges.append(abs(_gear(engine, model, i)) * model.actuator_forcerange[i])
    joint = model.actuator_trnid[i, 0]
    if model.actuator_trntype[i] == engine.mjtTrn.mjTRN_JOINT and model.jnt_actfrclimited[joint]:
        ranges.append(model.jnt_actfrcrange[joint])
    return float(min((min(-low, high) for low, high in ranges), default=np.inf))
