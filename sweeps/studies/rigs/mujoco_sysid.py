"""MuJoCo's own identification (`mujoco.sysid`), on the windows and parameters that ours has."""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import sysid

from simbias.core import Nominal
from simbias.core.parameters import Parameter
from simbias.core.records import Array
from simbias.robots.double_pendulum import DoublePendulum
from simbias.robots.mujoco.model import Mujoco
from simbias.robots.mujoco.parameters import put_values
from simbias.simulation.open_loop import Windows
from simbias.trial.study import Study

MOST = 4.0  # prior standard deviations that a parameter may go
STEPS = 10  # of its optimiser, at most; the last ones gain less than 1e-5 of the objective
LEAST_INERTIA = 1e-6  # kg m^2 about the centre of mass, which the double pendulum's parameters may not leave
HALF_PI = np.pi / 2  # Coulomb friction over c_f, of c_f arctan(100 v)


def fit(study: Study, windows: Windows) -> Nominal:
    """The model at its least squares, in units of each state's root mean square.

    It has no zeros of encoders, no offset of torques and no prior but bounds, at four deviations of ours.
    """
    robot = DoublePendulumFile(study) if isinstance(study.nominal, DoublePendulum) else File(study)
    parameters = sysid.ParameterDict({p.name: _bounded(p) for p in study.nominal.parameters})
    for each in parameters.values():
        each.move_off_bound()
    residual = sysid.build_residual_fn(
        models_sequences=[_sequences(study, robot.text(_values(parameters)), windows)],
        build_model=lambda changed, _: robot.compiled(_values(changed)),
        modify_residual=_residual(windows.states),
        resample_true=False,
    )
    with redirect_stdout(StringIO()):  # it prints each step
        found, _ = sysid.optimize(parameters, residual, max_iters=STEPS, verbose=False)
    return robot.nominal(_values(found))


class File:
    """A model that is an MJCF anyway."""

    def __init__(self, study: Study) -> None:
        assert isinstance(study.nominal, Mujoco)
        self._nominal = study.nominal
        self._model = mujoco.MjModel.from_xml_string(self._nominal.mjcf())

    def text(self, _: Mapping[str, float]) -> str:
        """The MJCF."""
        return self._nominal.mjcf()

    def compiled(self, values: Mapping[str, float]) -> mujoco.MjModel:
        """The engine's model with parameters by name."""
        model = copy.copy(self._model)
        put_values(model, values)
        return model

    def nominal(self, values: Mapping[str, float]) -> Nominal:
        """The same as a nominal model."""
        return self._nominal.with_parameters(np.array(list(values.values())))


class DoublePendulumFile:
    """The double pendulum in MuJoCo."""

    def __init__(self, study: Study) -> None:
        self._study = study
        self._text = Path(__file__).with_name("double_pendulum.xml").read_text()

    def text(self, values: Mapping[str, float]) -> str:
        """The MJCF with parameters by name."""
        nominal: Any = self._study.nominal
        v = nominal._values | values | {"time_step": self._study.task.time_step}
        for i in (1, 2):
            about_centre = v[f"inertia_{i}"] - v[f"mass_{i}"] * v[f"centre_{i}"] ** 2
            v |= {f"about_centre_{i}": max(LEAST_INERTIA, about_centre)}
            v |= {f"loss_{i}": HALF_PI * v[f"friction_{i}"]}
        driven = ("first", "second") if len(self._study.task.inputs) == 2 else (nominal._driven,)
        v["motors"] = "".join(f'<motor name="{joint}" joint="{joint}"/>' for joint in driven)
        return self._text.format(**v, geared_inertia=v["gear_ratio"] ** 2 * v["rotor_inertia"])

    def compiled(self, values: Mapping[str, float]) -> mujoco.MjModel:
        """The engine's model with parameters by name."""
        return mujoco.MjModel.from_xml_string(self.text(values))

    def nominal(self, values: Mapping[str, float]) -> Nominal:
        """The same as a nominal model."""
        with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
            file.write(self.text(values))
            file.flush()
            return Mujoco(self._study.task, file.name)


def _bounded(parameter: Parameter) -> sysid.Parameter:
    """A parameter within four deviations of its prior."""
    low, high = parameter.at(np.array([-MOST, MOST])).tolist()
    if parameter.prior == "half_normal":
        low = parameter.value
    return sysid.Parameter(parameter.name, np.clip(parameter.value, low, high), low, high)


def _values(parameters: Mapping[str, sysid.Parameter]) -> dict[str, float]:
    """Their values by name."""
    return {name: float(parameter.value[0]) for name, parameter in parameters.items()}


def _sequences(study: Study, mjcf: str, windows: Windows) -> sysid.ModelSequences:
    """Windows as its trajectories: where each begins, its inputs, and what was measured."""
    spec, n = mujoco.MjSpec.from_string(mjcf), windows.states.shape[1] // 2
    for kind in (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL):
        for joint in spec.joints:
            spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint.name)
    model = spec.compile()
    times = study.task.time_step * np.arange(windows.window + 1)
    rows = [start + np.arange(windows.window + 1) for start in windows.starts]
    return sysid.ModelSequences(
        "windows",
        spec,
        [str(i) for i in range(len(rows))],
        [sysid.create_initial_state(model, *np.split(windows.states[own[0]], [n])) for own in rows],
        [sysid.TimeSeries(times, windows.inputs[own]) for own in rows],
        [sysid.TimeSeries(times, windows.states[own]) for own in rows],
    )


def _residual(states: Array) -> Callable[..., Any]:
    """Errors of all states in each frame, over the root mean squares of states (F, n)."""
    scale = np.sqrt(np.mean(states**2, axis=0))

    def residual(_: Any, __: Any, measured: Any, *___: Any, state: Array) -> Any:
        return (state[:, 1:] - measured.data[1:]) / scale, measured, measured

    return residual
