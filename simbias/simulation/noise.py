"""Torque and sensor noise, on hardware and in simulation (Section VI-A)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import NonNegativeFloat

from simbias.records import Array


@dataclass(frozen=True)
class Noise:
    """Zero-mean Gaussian noise, of the variances of Table II."""

    torque_variance: NonNegativeFloat = 0.0  # sigma_tau^2, (N m)^2, on the joint torques
    angle_variance: NonNegativeFloat = 0.0  # sigma_p^2, rad^2, on the angles that the policy sees
    velocity_variance: NonNegativeFloat = 0.0  # sigma_v^2, (rad/s)^2, on the rates that the policy sees

    def draw(self, rng: np.random.Generator, frames: int, n: int, m: int) -> tuple[Array, Array]:
        """Noise on the inputs (frames, m) and on the sensors (frames+1, n), for a whole rollout.

        The first half of the n states are angles, the second half their rates. The draws depend neither on
        the variances nor on when the rollout fails, so noise levels compare on common random numbers.
        """
        torque = rng.standard_normal((frames, m))
        sensors = rng.standard_normal((frames + 1, n))
        variances = np.repeat([self.angle_variance, self.velocity_variance], n // 2)
        return np.sqrt(self.torque_variance) * torque, np.sqrt(variances) * sensors
