"""A robot's MuJoCo model: a file with joints as a task's states and actuators as its inputs."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from math import ceil
from typing import Any

import numpy as np

from simbias.core import Task
from simbias.core.messages import quote
from simbias.core.records import Array, Indices
from simbias.robots.mujoco.files import mjcf, read_model, source_files
from simbias.robots.mujoco.parameters import RELATIVE, mujoco, names_of, put_values

NO_ACTUATORS = "no actuators: name the joints to put motors at, as `actuators: [elbow]`"  # of a URDF
MOST_STEPS = 10_000  # of the engine per frame
STATE_UNITS = (  # of positions and velocities, by joint type in MuJoCo's order; "" for quaternions
    (("m",) * 3 + ("",) * 4, ("m/s",) * 3 + ("rad/s",) * 3),  # free
    (("",) * 4, ("rad/s",) * 3),  # ball
    (("m",), ("m/s",)),  # slide
    (("rad",), ("rad/s",)),  # hinge
)
INPUT_UNITS = ("", "", "N", "N m")  # of a motor, by its joint's type; "": any


class Mechanism:
    """A MuJoCo model whose state and input are those of a task.

    States are the positions of the joints, then their velocities. A hinge or a slide has one of each. A ball
    joint has a quaternion (w, x, y, z) and the angular velocity (3) in the body's frame; a free joint the
    position (x, y, z) and a quaternion, and the velocity (3) in the world's frame and the angular velocity in
    the body's. Quaternions are normalised in each step. Inputs are the forces and torques of motors (at a
    site: along the axis of their gear, else about it); for other actuators, inputs are their controls. A
    frame is a whole number of engine steps, which are as long as in the file, or slightly shorter.

    Parameters
    ----------
    file
        MJCF or URDF (`simbias.robots.mujoco.files.read_model`).
    joints, actuators
        Their names, in the order of states and inputs; by default all in the file, with joints in the order
        of the states if the names agree. An actuator may be a joint's name, as for a URDF, which has no
        actuators: a motor is added there.

    ValueError if MuJoCo is not installed, or the file cannot be read or does not fit the task.
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
        self.shares: dict[str, float] = {}  # set sizes and gains, relative to those of the file
        model = self.model = read_model(file, self._added)
        self._data = engine.MjData(model)  # for quantities derived from parameters, shared by all copies
        self.source_files = source_files(file)
        known, motors = names_of(model, "joint"), names_of(model, "actuator")
        joints = _in_order(known, task) if joints is None else list(joints)
        actuators = motors if actuators is None else list(actuators)
        _check(joints, known, "joints", file)
        _check(actuators, motors, "actuators", file)
        for name in known:
            if name not in joints:
                raise ValueError(f"{file}: joint {name}: all joints must be states")
        for order in task.joints:
            if sorted(joints) == sorted(order) and joints != list(order):
                raise ValueError(
                    f"joints: {', '.join(joints)} must be in the order of task.figure or task.sensors, "
                    f"{', '.join(order)}"
                )
        self.joints = tuple(joints)
        if len(task.states) != model.nq + model.nv:
            raise ValueError(
                f"the task has {len(task.states)} states; positions and velocities of the joints "
                f"{', '.join(joints)} are {model.nq} and {model.nv}"
            )
        if len(task.inputs) != len(actuators):
            has = f"actuators {', '.join(actuators)}" if actuators else NO_ACTUATORS
            raise ValueError(f"the task has {len(task.inputs)} inputs; {file} has {has}")
        self._check_states(task)
        steps = task.time_step / model.opt.timestep if model.opt.timestep > 0 else np.inf
        if steps > MOST_STEPS:
            raise ValueError(
                f"{file}: a frame of {task.time_step:g} s would take {steps:.3g} steps of "
                f"{model.opt.timestep:g} s (option timestep), more than {MOST_STEPS}"
            )
        self.substeps = ceil(steps - 1e-6)
        model.opt.timestep = task.time_step / self.substeps
        model.opt.disableflags |= engine.mjtDisableBit.mjDSBL_AUTORESET  # no reset after divergence
        if not (model.geom_contype.any() and model.geom_conaffinity.any()) and not model.npair:
            model.opt.disableflags |= engine.mjtDisableBit.mjDSBL_CONTACT  # skips the collision search
        positions = [_places(model.jnt_qposadr, model.nq, model.joint(name).id) for name in joints]
        velocities = [_places(model.jnt_dofadr, model.nv, model.joint(name).id) for name in joints]
        # (n,) indices in full states, after the time
        self.state_places = 1 + np.concatenate([*positions, *(model.nq + each for each in velocities)])
        self.control_places = np.array([model.actuator(name).id for name in actuators])  # (m,) in controls
        self.units = np.array([_unit(model, i) for i in self.control_places])  # (m,) of controls
        self._check_inputs(task, actuators)

    def _check_states(self, task: Task) -> None:
        """Refuse states in other units than those of the engine."""
        types = [self.model.joint(name).type[0] for name in self.joints]
        wanted = [unit for part in (0, 1) for each in types for unit in STATE_UNITS[each][part]]
        for state, unit in zip(task.states, wanted, strict=True):
            if unit not in ("", state.unit):
                raise ValueError(
                    f"the task's state {state.name} is in {state.unit}; in {self._file} it is in {unit}"
                )

    def _check_inputs(self, task: Task, actuators: Sequence[str]) -> None:
        """Refuse inputs in other units than those of motors, or beyond the actuators' limits."""
        model = self.model
        places = zip(task.inputs, actuators, self.control_places, self.units, strict=True)
        for (quantity, name, index, unit), lower, upper in zip(places, *task.input_bounds, strict=True):
            if not unit:
                raise ValueError(f"{self._file}: the motor {name} has a gear or a gain of zero")
            force = _input_unit(model, index)  # volts, or a share, may differ from it by a gain
            bare = re.sub(r"[\s·*.]", "", quantity.unit)
            if force and "N" in bare and bare != force.replace(" ", ""):
                raise ValueError(
                    f"the task's input {quantity.name} is in {quantity.unit}; the motor {name} has {force}"
                )
            least, most = _reach(model, index, unit)
            for asked, given, beyond in ((upper, most, upper - most), (lower, least, least - lower)):
                if beyond > 1e-9 * abs(given):
                    raise ValueError(
                        f"the task's input may be {asked:g}; the actuator {name} gives {given:g} "
                        f"({quantity.unit}; a motor's inputs are forces or torques, control times gear; that "
                        f'of an actuator with biastype="affine" is its control, as the voltage of a DC motor)'
                    )

    @property
    def hidden(self) -> list[str]:
        """Actuators with internal states, which the task's states do not show."""
        return [self.model.actuator(i).name for i in np.flatnonzero(self.model.actuator_dyntype)]

    def with_values(self, values: Mapping[str, float]) -> Mechanism:
        """The mechanism with other parameter values, by name, in their units or relative to the file's."""
        changed = copy.copy(self)
        changed.model = copy.copy(self.model)
        put_values(changed.model, {n: v / self.shares.get(n, 1.0) for n, v in values.items()}, self._data)
        changed.shares = self.shares | {n: v for n, v in values.items() if n.endswith(RELATIVE)}
        return changed

    def without_input_limits(self) -> Mechanism:
        """The mechanism without input limits of its actuators; written files keep the limits."""
        changed = self.with_values({})
        for i, unit in zip(self.control_places.tolist(), self.units.tolist(), strict=True):
            for limited, place, _ in _limits(changed.model, i, unit):
                limited[place] = 0
        return changed

    def text(self) -> str:
        """The mechanism as MJCF."""
        return mjcf(self._file, self._added, self.model)

    def physics(self, x: Array) -> Array:
        """MuJoCo's full states (k, .) at states x (k, n)."""
        size = mujoco().mj_stateSize(self.model, mujoco().mjtState.mjSTATE_FULLPHYSICS)
        full = np.zeros((len(x), size))  # time, positions, velocities, others
        full[:, self.state_places] = x
        return full

    def states(self, full: Array) -> Array:
        """States x (k, n) from MuJoCo's full states (k, .)."""
        return full[:, self.state_places]

    def controls(self, u: Array) -> Array:
        """Controls (k, .) from inputs u (k, m)."""
        controls = np.zeros((len(u), self.model.nu))
        controls[:, self.control_places] = u / self.units
        return controls


def _in_order(joints: list[str], task: Task) -> list[str]:
    """Joints of a file in the order of the task's states, if the names agree; else in the file's order."""
    positions = [state.name for state in task.states[: len(joints)]]
    return positions if sorted(positions) == sorted(joints) else joints


def _check(wanted: Sequence[str], known: Sequence[str], key: str, file: str) -> None:
    """Check that a file has these names, each for a different element."""
    for i, name in enumerate(wanted):
        if name not in known:
            raise ValueError(f"{key}: {file} has no {quote(name)}; it has {', '.join(known)}")
        if name in wanted[:i]:
            raise ValueError(f"{key}: {quote(name)} is named twice")


def _places(addresses: Indices, count: int, joint: int) -> Indices:
    """Indices of a joint's numbers among `count`: from its address up to the next joint's."""
    return np.arange(count)[addresses[joint] : [*addresses, count][joint + 1]]


def _is_motor(model: Any, i: int) -> bool:
    """Whether an actuator's force or torque is proportional to its control."""
    fixed, none = mujoco().mjtGain.mjGAIN_FIXED, mujoco().mjtBias.mjBIAS_NONE
    return bool(model.actuator_gaintype[i] == fixed and model.actuator_biastype[i] == none)


def _unit(model: Any, i: int) -> float:
    """The input for a control of 1: the force or torque of a motor, else 1."""
    motor = _is_motor(model, i)
    return float(_gear(model, i) * model.actuator_gainprm[i, 0]) if motor else 1.0


def _input_unit(model: Any, i: int) -> str:
    """The unit of an actuator's input: force or torque for a motor on a joint; "" for others."""
    on_joint = model.actuator_trntype[i] == mujoco().mjtTrn.mjTRN_JOINT and _is_motor(model, i)
    return INPUT_UNITS[model.jnt_type[model.actuator_trnid[i, 0]]] if on_joint else ""


def _gear(model: Any, i: int) -> float:
    """The gear; for an actuator at a site, the force along the axis of its six gears, or the torque about it.

    On a ball joint, gears act about three axes; on a free joint, they act as at a site.
    """
    gear, kind, target = model.actuator_gear[i], model.actuator_trntype[i], model.actuator_trnid[i, 0]
    is_free = kind == mujoco().mjtTrn.mjTRN_SITE
    if _is_on_joint(model, i):
        if model.jnt_type[target] == int(mujoco().mjtJoint.mjJNT_BALL):
            return float(np.linalg.norm(gear[:3]))
        is_free = model.jnt_type[target] == int(mujoco().mjtJoint.mjJNT_FREE)
    return float(np.linalg.norm(gear[:3]) or np.linalg.norm(gear[3:])) if is_free else float(gear[0])


def _is_on_joint(model: Any, i: int) -> bool:
    """Whether an actuator acts at a joint, in its own frame or in its parent's."""
    kind, transmission = model.actuator_trntype[i], mujoco().mjtTrn
    return bool(kind == transmission.mjTRN_JOINT or kind == transmission.mjTRN_JOINTINPARENT)


def _reach(model: Any, i: int, unit: float) -> tuple[float, float]:
    """Least and largest input of an actuator, by the limits in its file."""
    ranges = [limits for limited, place, limits in _limits(model, i, unit) if limited[place]]
    low, high = np.sort([(-np.inf, np.inf), *ranges], axis=1).T  # a gear may be negative
    return float(low.max()), float(high.min())


def _limits(model: Any, i: int, unit: float) -> list[tuple[Any, int, Array]]:
    """Limits of an actuator's control and, for a motor, of its force.

    Each is a tuple: the array of flags, the index in it, and the input's range; a limit applies if its flag
    is set.
    """
    found = [(model.actuator_ctrllimited, i, unit * model.actuator_ctrlrange[i])]
    if _is_motor(model, i):
        kind, target = model.actuator_trntype[i], int(model.actuator_trnid[i, 0])
        found.append((model.actuator_forcelimited, i, _gear(model, i) * model.actuator_forcerange[i]))
        if _is_on_joint(model, i):
            found.append((model.jnt_actfrclimited, target, model.jnt_actfrcrange[target]))
        elif kind == mujoco().mjtTrn.mjTRN_TENDON:
            found.append((model.tendon_actfrclimited, target, model.tendon_actfrcrange[target]))
    return found
