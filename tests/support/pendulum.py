"""The double pendulum, and experiments that are simulated on a model of it."""

import numpy as np
from models import driven

import simbias
from simbias.core import Nominal
from simbias.core.parameters import values_at
from simbias.core.records import Array, Rollout
from simbias.trial.study import Study

COLUMNS = "pos1:pos_meas1,pos2:pos_meas2,vel1:vel_meas1,vel2:vel_meas2,tau1:tau_meas1,tau2:tau_meas2"
OPTIONS = [
    *("preset=double_pendulum", "identification=none", "bias=gp", "tracking=none"),
    *("hardware.folder=tests/recordings", f"hardware.columns={{{COLUMNS}}}"),
]
QUICK = ["identification=posterior", "identification.starts=4", "identification.rounds=2"]
NOISE = np.array([2e-4, 2e-4, 0.05, 0.05])  # rad, rad/s


def pendulum(*more: str) -> Study:
    """A study of it."""
    return simbias.load([*OPTIONS, *more])


def experiment(
    nominal: Nominal, rng: np.random.Generator, frames: int = 1000, noise: Array = NOISE
) -> Rollout:
    """Two seconds under smooth random torques, measured with noise."""
    t = np.arange(frames)[:, None] * 0.002
    u = np.sum([0.5 * np.sin(rng.uniform(3, 12, 2) * t + rng.uniform(0, 6, 2)) for _ in range(3)], axis=0)
    measured = driven(nominal, np.zeros(4), u) + noise * rng.standard_normal((frames + 1, 4))
    return Rollout(measured, u, measured=measured, sensed=True)


def truth(nominal: Nominal, rng: np.random.Generator) -> tuple[Nominal, Array]:
    """A model drawn from the prior, and its parameters' values."""
    values = values_at(nominal.parameters, rng.standard_normal(len(nominal.parameters)))
    return nominal.with_parameters(values), values
