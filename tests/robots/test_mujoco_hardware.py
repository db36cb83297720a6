"""MuJoCo as hardware: without a gap it is the nominal model, and each gap does what it says."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mechanisms import cart_pole, mjcf

from simbias.core.records import Rollout
from simbias.policy.output_feedback import OutputFeedback
from simbias.robots.mujoco.hardware import Mujoco
from simbias.robots.mujoco.model import Mujoco as NominalMujoco

START = np.array([0.0, 0.1, 0.0, 0.0])
THETA = np.array([-0.5, -3.0, -1.0, -1.5])


def run(folder: Path, theta: np.ndarray = THETA, seed: int = 0, **gap: Any) -> Rollout:
    task = cart_pole()
    hardware = Mujoco(task, mjcf(folder), **gap)
    return hardware.run(OutputFeedback(task), theta, START, np.random.default_rng(seed))


def test_it_is_the_nominal_model_but_for_its_gap(tmp_path: Path) -> None:
    """Other parameters are those of a model with them; a delayed input acts so many frames later."""
    other: dict[str, Any] = {"values": {"hinge.damping": 0.4}, "factors": {"*.mass": 1.3, "push.gain": 0.4}}
    for delay, gap in ((0, {}), (3, {}), (0, other)):
        made = run(tmp_path, delay=delay, **gap)
        model = NominalMujoco(cart_pole(), mjcf(tmp_path), **gap)
        assert made.frames > 5
        acted = np.concatenate([np.zeros((delay, 1)), made.inputs])[: made.frames]
        predicted = model.step(made.states[:-1], acted)
        np.testing.assert_allclose(made.states[1:], predicted, rtol=1e-12, atol=1e-12)


def test_an_unstable_simulation_leaves_no_file(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    robot = Mujoco(cart_pole(), mjcf(folder))
    with caplog.at_level(logging.INFO):
        robot.run(
            OutputFeedback(cart_pole()), THETA, np.array([0.0, 0.1, 1e12, 0.0]), np.random.default_rng(0)
        )
    assert "The simulation is unstable" in caplog.text
    assert not (folder / "MUJOCO_LOG.TXT").exists()
