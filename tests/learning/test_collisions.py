"""Parameters of what bounces: predictions are exact in the air, and far off where it bounces early."""

from __future__ import annotations

from copy import copy

import numpy as np
import pytest
from models import driven

from simbias.core import Nominal
from simbias.core.parameters import uncertain
from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import Identified
from simbias.learning.identification.posterior import Posterior
from simbias.learning.identification.problem import Differences
from simbias.robots.declared.declarations import Input
from simbias.robots.declared.starts import State
from simbias.robots.declared.task import Declared

pytestmark = pytest.mark.usefixtures("plain_predictions")

FRAME, STEPS = 0.02, 20  # s, steps of a frame
DECLARED = {"gravity": 9.0, "ground": 0.05}
TASK = Declared(
    states={"height": State("m", "position"), "speed": State("m/s", "velocity")},
    inputs={"push": Input(unit="m/s^2", kind="acceleration", limit=20.0)},
    time_step=FRAME,
    horizon=100,
)


class Bouncing(Nominal):
    """A ball above springy ground."""

    def __init__(self, gravity: float, ground: float, rate: float = 60.0) -> None:
        self._rate = rate  # rad/s, of the ground's spring
        self._values = {"gravity": gravity, "ground": ground}
        self.parameters = uncertain(DECLARED, dict.fromkeys(DECLARED, ""), {"gravity": 0.2, "ground": 0.5})

    def step(self, x: Array, u: Array) -> Array:
        height, speed = x[..., 0], x[..., 1]
        for _ in range(STEPS):
            depth = self._values["ground"] - height
            push = np.where(
                depth > 0.0, np.maximum(self._rate**2 * depth - 0.2 * self._rate * speed, 0.0), 0.0
            )
            speed = speed + FRAME / STEPS * (push - self._values["gravity"] + u[..., 0])
            height = height + FRAME / STEPS * speed
        return np.stack([height, speed], axis=-1)

    def with_parameters(self, values: Array) -> Bouncing:
        changed = copy(self)
        changed._values = dict(zip(self._values, map(float, values), strict=True))
        return changed


TRUTH = Bouncing(9.8, 0.03, rate=90.0)


def bounced() -> Rollout:
    inputs = np.random.default_rng(0).uniform(-5.0, 5.0, (100, 1))
    return Rollout(driven(TRUTH, np.array([0.5, 0.0]), inputs), inputs)


def fitted(differences: Differences = "forward", **noise: float) -> Identified:
    identification = Posterior(
        TASK, window=0.1, chunks=10, starts=4, rounds=2, noise=noise, differences=differences
    )
    return identification.fit(Bouncing(**DECLARED), [bounced()])  # type: ignore[return-value]


@pytest.mark.slow
def test_no_posterior_is_far_wider_than_the_prior() -> None:
    """The ground is harder than the model's: without noise, bounces are outliers by a factor of thousands.

    By forward differences it is, as in trials that were published before.
    """
    assert np.linalg.eigvalsh(fitted().covariance).max() > 1e3
    for bounded in (fitted("central"), fitted(position_variance=1e-14)):
        assert np.linalg.eigvalsh(bounded.covariance).max() < 1.0 + 1e-9


@pytest.mark.slow
def test_with_the_noise_of_what_is_measured_bounces_tell_of_parameters() -> None:
    found = fitted(position_variance=1e-6, velocity_variance=2.5e-3)
    gravity, ground = found.estimates
    assert gravity.low < 9.8 < gravity.high
    assert gravity.value == pytest.approx(9.8, rel=0.03)
    assert 0.03 < ground.value < 0.045  # higher: the ball turns back earlier than on softer ground
    assert np.linalg.eigvalsh(found.covariance).max() < 0.2
