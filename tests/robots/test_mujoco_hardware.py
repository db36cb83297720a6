"""MuJoCo as hardware: without a gap it is the nominal model, and each gap does what it says."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mechanisms import cart_pole, mjcf

from simbias.core.records import Array, Rollout
from simbias.policy.output_feedback import OutputFeedback
from simbias.robots.mujoco.hardware import Mujoco
from simbias.robots.mujoco.model import Mujoco as NominalMujoco
from simbias.simulation.control_loop import BLOW_UP, Robot, experiment
from simbias.simulation.noise import Noise

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


def test_noise_is_seen_and_recorded_as_told(tmp_path: Path) -> None:
    """The record is of the measured states, failure is judged by the true ones; the seed decides."""
    noise = {"angle_variance": 1e-4, "force_variance": 1.0}
    true, measured = (run(tmp_path, noise=noise, record=record) for record in ("true_state", "measured"))
    np.testing.assert_array_equal(true.measured, measured.states)
    assert measured.sensed
    assert not true.sensed
    difference = true.measured - true.states
    assert difference[:, 1].std() > 0.005
    assert not difference[:, [0, 2, 3]].any()
    assert not np.array_equal(run(tmp_path, noise=noise, seed=1).inputs, true.inputs)


def test_a_fall_ends_it(tmp_path: Path) -> None:
    fallen = run(tmp_path, np.array([0.0, -5.0, 0.0, 0.0]))
    assert fallen.failure == "falls"
    assert fallen.failed_at == fallen.frames < 50
    assert abs(fallen.states[-1, 1]) > 1.0 >= abs(fallen.states[-2, 1])


class Exploding(Robot):
    """A robot whose state is no number after five frames."""

    def __init__(self) -> None:
        self.frames = 0

    def state(self) -> Array:
        return np.full(4, np.nan if self.frames == 5 else 0.0)

    def step(self, u: Array) -> None:
        self.frames += 1

    def failure(self) -> None:
        return None


def test_what_blows_up_ends_with_the_state_before() -> None:
    task = cart_pole()
    noise = Noise(task, {}).draw(np.random.default_rng(0))
    made = experiment(task, Exploding(), OutputFeedback(task), THETA, noise, "true_state")
    assert (made.failure, made.failed_at, made.frames, len(made.states)) == (BLOW_UP, 4, 4, 5)


def test_an_unstable_simulation_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    robot = Mujoco(cart_pole(), mjcf(tmp_path))
    with caplog.at_level(logging.INFO):
        robot.run(
            OutputFeedback(cart_pole()), THETA, np.array([0.0, 0.1, 1e12, 0.0]), np.random.default_rng(0)
        )
    assert "The simulation is unstable" in caplog.text
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
