"""Files of a pole on a cart, and tasks for them."""

from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from simbias.config.components import construct
from simbias.core import Task
from simbias.robots.declared.task import Declared

CONF = Path(__file__).parents[2] / "conf"
DOUBLE = "gymnasium:envs/mujoco/assets/inverted_double_pendulum.xml"
MJCF = """
<mujoco>
  <option integrator="RK4" timestep="{step}" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" damping="{damping}"/>
      <inertial mass="2" pos="0 0 0" diaginertia="0.1 0.1 0.1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="{damping}"/>
        <inertial mass="0.5" pos="0 0 {half}" diaginertia="{inertia} {inertia} {inertia}"/>
        <geom name="rod" type="capsule" fromto="0 0 0 0 0 {length}" size="0.01" contype="0" conaffinity="0"/>
        <body name="tip" pos="0 0 {length}">
          <inertial mass="0.1" pos="0 0 0" diaginertia="1e-6 1e-6 1e-6"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""
MOTOR = '<motor name="push" joint="slider" gear="20" ctrllimited="true" ctrlrange="-1 1"/>'
LIFT = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="body">
      <joint name="up" type="slide" axis="0 0 1"/>
      <inertial mass="2" pos="0 0 0" diaginertia="1 1 1"/>
      <site name="propeller" quat="1 1 0 0"/>
    </body>
  </worldbody>
  <actuator><motor name="lift" site="propeller" gear="0 4 0 0 -0.1 0" ctrlrange="-5 5"/></actuator>
</mujoco>
"""
URDF = """
<robot name="slider">
  <link name="cart">
    <inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="base">
    <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="rail" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
    <limit lower="-9" upper="9" effort="20" velocity="9"/></joint>
</robot>
"""


def mjcf(
    folder: Path, *, length: float = 0.8, damping: float = 0.0, actuators: str = MOTOR, step: float = 0.005
) -> str:
    """A file of a thin, uniform pole of 0.5 kg on a cart of 2 kg, and a weight of 0.1 kg at its tip."""
    file = folder / f"pole_{length}.xml"
    values = {"length": length, "half": length / 2, "inertia": 0.5 * length**2 / 12}
    file.write_text(MJCF.format(**values, damping=damping, actuators=actuators, step=step))
    return str(file)


@cache
def shipped_task(name: str) -> Any:
    """What conf/task/NAME.yaml says."""
    return OmegaConf.to_container(OmegaConf.load(CONF / "task" / f"{name}.yaml"))


def drawn_from(**figure: Any) -> Declared:
    """The double cart-pole's task, drawn from a file."""
    return construct({**shipped_task("double_cartpole"), "drawing": None, "figure": figure}, Task, "task")


CARTPOLE = shipped_task("cartpole")


def declared(**changes: Any) -> Declared:
    """The shipped cart-pole's task with other values."""
    return construct({**CARTPOLE, **changes}, Task, "task")


def cart_pole(**changes: Any) -> Declared:
    """A task for that file; or for another, with other states."""
    states = {"position": "m", "angle": "rad", "d_position": "m/s", "d_angle": "rad/s"}
    config = {
        "_target_": "simbias.robots.declared.task.Declared",
        "time_step": 0.02,
        "horizon": 50,
        "states": {name: {"unit": unit, "deviation": 0.1} for name, unit in states.items()},
        "inputs": {"force": {"unit": "N", "limit": 20.0}},
        "failure": {"falls": {"value": "abs(angle)", "above": 1.0}},
    }
    return construct({**config, **changes}, Task, "task")


_PROPELLERS = {
    "m1": (0.1, 0.1, -0.02),
    "m2": (-0.1, 0.1, 0.02),
    "m3": (-0.1, -0.1, -0.02),
    "m4": (0.1, -0.1, 0.02),
}
QUADROTOR = f"""
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="body" pos="0 0 1">
      <freejoint/>
      <inertial mass="1" pos="0 0 0" diaginertia="0.01 0.01 0.02"/>
      <geom type="box" size="0.1 0.1 0.02"/>
      {"".join(f'<site name="{name}" pos="{x} {y} 0"/>' for name, (x, y, _) in _PROPELLERS.items())}
    </body>
  </worldbody>
  <actuator>{
    "".join(
        f'<motor name="{name}" site="{name}" gear="0 0 1 0 0 {-drag}" ctrlrange="0 6"/>'
        for name, (_, _, drag) in _PROPELLERS.items()
    )
}</actuator>
  <sensor>
    <framezaxis name="up" objtype="site" objname="m1"/>
    <gyro name="gyro" site="m1"/>
    <accelerometer name="felt" site="m1"/>
  </sensor>
</mujoco>
"""


def quadrotor(limit: float = 6.0, lower: float | None = 0.0, **changes: Any) -> Declared:
    """A task for that file: to stay near (0, 0, 1), upright."""
    units = {"x": "m", "y": "m", "z": "m", "qw": "1", "qx": "1", "qy": "1", "qz": "1"}
    units |= {"vx": "m/s", "vy": "m/s", "vz": "m/s", "wx": "rad/s", "wy": "rad/s", "wz": "rad/s"}
    states = {name: {"unit": unit, "deviation": 0.05} for name, unit in units.items()}
    for name in ("z", "qw"):
        states[name]["mean"] = 1.0
    config: dict[str, Any] = {
        "states": states,
        "inputs": {name: {"unit": "N", "limit": limit, "lower": lower} for name in _PROPELLERS},
        "failure": {"falls": {"value": "qw", "below": 0.5}, "away": {"value": "abs(z - 1)", "above": 1.0}},
    }
    return cart_pole(**config | changes)
