"""A ball in a cup and a hopper: conservation laws, and their equations beside MuJoCo's."""

from collections.abc import Sequence

import numpy as np
import pytest

import simbias
from simbias.core import Nominal
from simbias.core.records import Array
from simbias.robots.hopper import FOOT_CENTRE, FOOT_MASS, LEG_INERTIA, LENGTH, UPPER_CENTRE, UPPER_MASS
from simbias.robots.mujoco.model import Mujoco
from simbias.trial.study import Study

EQUAL = {  # to the hardware's file
    "ball_in_cup": {"cup_mass": 0.5, "ball_mass": 0.06, "string": 0.3, "damping": 1.0},
    "hopper": {
        "torso_mass": 4.0,
        "torso_inertia": 0.2,
        "stiffness": 1000.0,
        "damping": 5.0,
        "hip_damping": 0.1,
    },
}


def loaded(preset: str, **values: float) -> Study:
    options = [f"nominal.{name}={value}" for name, value in values.items()]
    return simbias.load([f"preset={preset}", "tracking=none", *options])


def rolled(model: Nominal, start: Sequence[float], inputs: Array) -> Array:
    """States (T+1, n) of a model under inputs (T, m)."""
    states = [np.array(start, dtype=np.float64)]
    for u in inputs:
        states.append(model.step(states[-1], u))
    return np.array(states)


@pytest.mark.slow
def test_equations_are_the_engines_at_equal_parameters() -> None:
    """Within millimetres and milliradians, by another integrator and other contacts, for half a second."""
    cases: list[tuple[str, list[float], float, float]] = [
        ("ball_in_cup", [0, 0, 0, -0.3, 0, 0, 0, 0], 4.0, 0.003),  # it hangs, and is swung
        ("ball_in_cup", [0, 0, 0.01, 0.15, 0, 0, 0, 0], 0.0, 0.003),  # it falls into the cup
        ("hopper", [0, 1.5, 0.1, 0.2, 0, 0.3, 0, 0.5, -0.5, 0], 10.0, 0.03),  # in the air, its leg turning
        ("hopper", [0, 0.55, 0, 0, 0, 0, 0, 0, 0, 0], 0.0, 0.001),  # it falls onto its foot, and stands
    ]
    for preset, start, amplitude, error in cases:
        study = loaded(preset, **EQUAL[preset])
        engine = Mujoco(study.task, study.config["hardware"]["file"])
        t = study.task.time_step * np.arange(round(0.5 / study.task.time_step))
        inputs = amplitude * np.stack([np.sin(15 * t), np.cos(10 * t)], axis=1)
        made, expected = (rolled(model, start, inputs) for model in (study.nominal, engine))
        places = len(start) // 2
        assert np.abs(made - expected)[:, :places].max() < error
        assert np.abs(np.diff(expected[:, :places], axis=0)).max() > 1e-3


def test_what_the_ball_gets_the_cup_loses() -> None:
    """Momentum along x, without damping of the rails: string and walls act on both."""
    study = loaded("ball_in_cup", cup_mass=0.5, ball_mass=0.2)
    for start in (
        [0, 0, 0.3, -0.3, 0, 0, 1, 2],
        [0, 0, 0.0, 0.1, 0.1, 0, 0.5, -2],
        [0, 0, 0.2, 0.05, 0, 0, -3, 0],
    ):
        states = rolled(study.nominal, start, np.zeros((40, 2)))
        momentum = 0.5 * states[:, 4] + 0.2 * states[:, 6]
        np.testing.assert_allclose(momentum, momentum[0], atol=1e-12)
        assert np.ptp(states[:, 4]) > 0.1  # they have met


def test_a_hopper_in_the_air_flies_as_its_centre_of_mass() -> None:
    """A parabola, and angular momentum about it is kept, whatever the joints do, to the step's order."""
    study = loaded("hopper", torso_mass=4.0, torso_inertia=0.2)
    t = study.task.time_step * np.arange(40)
    inputs = np.stack([5 * np.sin(20 * t), 40 * np.cos(15 * t)], axis=1)
    x = rolled(study.nominal, [0, 2, 0.1, 0.2, 0, 0.5, 1, 1, -2, 0], inputs)
    leg, turn = x[:, 2] + x[:, 3], x[:, 7] + x[:, 8]
    along = np.stack([-np.sin(leg), -np.cos(leg)], axis=1)
    across = np.stack([-np.cos(leg), np.sin(leg)], axis=1)
    masses = np.array([4.0, UPPER_MASS, FOOT_MASS])
    places, velocities = [], []
    for far, rate in (
        (0 * leg, 0 * leg),
        (UPPER_CENTRE + 0 * leg, 0 * leg),
        (FOOT_CENTRE + x[:, 4], x[:, 9]),
    ):
        places.append(x[:, :2] + far[:, None] * along)
        velocities.append(x[:, 5:7] + (far * turn)[:, None] * across + rate[:, None] * along)
    centre, velocity = (np.average(each, axis=0, weights=masses) for each in (places, velocities))
    t = study.task.time_step * np.arange(len(x))
    np.testing.assert_allclose(velocity[:, 0], velocity[0, 0], atol=0.02)
    np.testing.assert_allclose(velocity[:, 1], velocity[0, 1] - 9.81 * t, atol=0.03)
    np.testing.assert_allclose(centre[:, 1], centre[0, 1] + velocity[0, 1] * t - 4.905 * t**2, atol=0.01)
    spin = 0.2 * x[:, 7] + LEG_INERTIA * turn  # clockwise, as z cross x
    for m, place, v in zip(masses, places, velocities, strict=True):
        r, w = place - centre, v - velocity
        spin = spin + m * (r[:, 1] * w[:, 0] - r[:, 0] * w[:, 1])
    np.testing.assert_allclose(spin, spin[0], atol=0.02)
    assert np.ptp(x[:, 7]) > 0.5


@pytest.mark.slow
def test_a_sole_grips_as_far_as_friction_goes() -> None:
    """A leg that leans by 0.3 rad on the ground: friction of 1 holds its foot, of 0.05 does not."""
    slid = []
    for friction in (1.0, 0.05):
        study = loaded("hopper", friction=friction, torso_inertia=10.0, damping=50.0)
        x = rolled(study.nominal, [0, 0.5 * np.cos(0.3), 0, 0.3, -0.03, 0, 0, 0, 0, 0], np.zeros((15, 2)))
        foot = x[:, 0] - (LENGTH + x[:, 4]) * np.sin(x[:, 2] + x[:, 3])
        slid.append(abs(foot[-1] - foot[3]))
    assert slid[0] < 0.003
    assert slid[1] > 0.02
