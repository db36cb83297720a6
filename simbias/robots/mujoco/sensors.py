"""Sensor values and site positions of a MuJoCo model in a state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from simbias.core import Task
from simbias.core.files import ConfigFile
from simbias.core.messages import quote
from simbias.core.records import Array
from simbias.robots.mujoco.mjcf import Mechanism
from simbias.robots.mujoco.parameters import mujoco
from simbias.simulation.compiler import is_traced


@dataclass(frozen=True)
class SensorFile:
    """A file, as for `simbias.robots.mujoco.mjcf.Mechanism`, and the sensors and sites to read."""

    file: ConfigFile
    sensors: list[str] | None = None  # None: all named ones that depend only on the state
    sites: list[str] | None = None  # whose positions (3) in m are read
    joints: list[str] | None = None  # in the order of the states, as for the nominal model
    actuators: list[str] | None = None


class Sensors:
    """Values of sensors and positions of sites at states.

    ValueError if the file does not fit the task, has no such sensor or site, or a sensor measures forces or
    accelerations, which the state alone does not determine.
    """

    def __init__(self, task: Task, source: SensorFile) -> None:
        engine = mujoco()
        self._robot = Mechanism(task, source.file, source.joints, source.actuators)
        self.source_files, self.joints = self._robot.source_files, self._robot.joints
        model = self._robot.model
        self._data: Any = engine.MjData(model)
        known = {model.sensor(i).name: model.sensor(i) for i in range(model.nsensor)}
        stage = int(engine.mjtStage.mjSTAGE_VEL)  # up to here, states determine a sensor's value
        told = [name for name, sensor in known.items() if name and int(sensor.needstage[0]) <= stage]
        sizes: list[tuple[str, int]] = []
        self._places: list[int] = []
        for name in told if source.sensors is None else source.sensors:
            if name not in told:
                why = "measures forces or accelerations" if name in known else "does not exist"
                raise ValueError(f"{source.file}: sensor {quote(name)} {why}; available: {', '.join(told)}")
            first, size = int(known[name].adr[0]), int(known[name].dim[0])
            sizes.append((name, size))
            self._places += range(first, first + size)
        sites = {model.site(i).name: i for i in range(model.nsite)}
        for name in source.sites or ():
            if name not in sites:
                raise ValueError(f"{source.file}: no site {quote(name)}; available: {', '.join(sites)}")
            sizes.append((name, 3))
        self._sites = [sites[name] for name in source.sites or ()]
        self.names = [name if size == 1 else f"{name}[{i}]" for name, size in sizes for i in range(size)]

    def __call__(self, x: Array) -> Array:
        """Values (..., s), in the order of `names`, at states x (..., n); TypeError if these are symbols."""
        if is_traced(x):
            raise TypeError("the engine computes sensors and sites")
        rows = x.reshape(-1, x.shape[-1])
        values = np.array([self._read(full) for full in self._robot.physics(rows)])
        return values.reshape(*x.shape[:-1], len(self.names))

    def _read(self, full: Array) -> Array:
        """The values (s,) at a full state of the engine."""
        if not np.isfinite(full).all():
            return np.full(len(self.names), np.nan)
        engine, model, data = mujoco(), self._robot.model, self._data
        engine.mj_setState(model, data, full, engine.mjtState.mjSTATE_FULLPHYSICS)
        engine.mj_fwdPosition(model, data)
        engine.mj_sensorPos(model, data)
        engine.mj_fwdVelocity(model, data)
        engine.mj_sensorVel(model, data)
        return np.concatenate([data.sensordata[self._places], data.site_xpos[self._sites].ravel()])
