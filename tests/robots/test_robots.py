"""Robots that ship: what some of them do, and the pictures of a task that is declared in YAML."""

from io import BytesIO

import numpy as np
import pytest
from PIL import Image

import simbias
from simbias.pictures.trial.animation import save_animation
from simbias.pictures.trial.overview import overview
from simbias.robots.mujoco.hardware import Mujoco
from simbias.trial.run import run_trial

pytestmark = pytest.mark.slow


def test_the_acrobots_engine_is_its_model_without_friction_rotors_and_delay() -> None:
    """MuJoCo and the published equations, each by steps of its own."""
    study = simbias.load(["tracking=none", "preset=acrobot"])
    nothing = {"*.friction": 0.0, "*.damping": 0.0, "*.armature": 0.0}
    robot = Mujoco(study.task, study.config["hardware"]["file"], values=nothing)
    theta, start = np.array([4.5, 3.0, 0.0, 0.5]), np.array([0.02, 0.0, 0.0, 0.0])
    made = robot.run(study.policy, theta, start, np.random.default_rng(0))
    predicted = study.nominal.step(made.states[:-1], made.inputs)
    assert made.frames > 100
    assert np.abs(made.states).max(axis=0)[1] > 0.1
    np.testing.assert_allclose(predicted, made.states[1:], atol=2e-3)


@pytest.mark.usefixtures("uncompiled")
def test_a_biped_stands_by_contact_under_stiff_joints_and_falls_without_torque() -> None:
    """As the model and as the hardware; its plate moves meanwhile."""
    study = simbias.load(["tracking=none", "preset=biped"])
    gains = np.array([-300.0, 0.0, -50.0, 0.0, 0.0, -200.0, 0.0, -20.0])
    theta = np.sign(gains) * np.log1p(np.abs(gains))
    for made in (study.simulate(theta), study.experiment(theta, np.random.default_rng(0))):
        assert made.failure is None
        assert np.ptp(made.states[:, 0]) > 0.03  # m, of the plate
        assert np.abs(made.states[:, 2]).max() < 2e-3  # m, of the feet off the plate
    assert study.experiment(np.zeros(8), np.random.default_rng(0)).failure == "leans"


@pytest.mark.usefixtures("uncompiled")
def test_a_pole_is_held_upright_after_few_experiments() -> None:
    """Its drawing is in every picture: the overview's snapshots have its parts, the animation moves them."""
    study = simbias.load(["tracking=none", "preset=cartpole", "optimizer.max_evaluations=200"])
    iterations = list(run_trial(study).iterations)
    assert iterations[-1].succeeded
    assert iterations[-1].total_experiments <= 6
    parts = [len(axes.patches) for axes in overview(study, iterations).axes]
    assert parts.count(len(study.task.drawing)) >= 2
    file = BytesIO()
    save_animation(study, iterations[-1:], file)
    assert Image.open(file).n_frames > 20
