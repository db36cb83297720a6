"""A ball in a cup, a hopper, a pole on a cart: conservation laws, and equations beside MuJoCo's."""

from collections.abc import Sequence

import numpy as np
import pytest
from mechanisms import cart_pole

import simbias
from simbias.core import Nominal
from simbias.core.records import Array
from simbias.robots.cartpole import CartPole
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


@pytest.mark.slow
def test_what_the_ball_gets_the_cup_loses() -> None:
    """Momentum along x, without damping of the rails: string and walls act on both."""
    study = loaded("ball_in_cup", cup_mass=0.5, ball_mass=0.2)
    starts = [0, 0, 0.3, -0.3, 0, 0, 1, 2], [0, 0, 0, 0.1, 0.1, 0, 0.5, -2], [0, 0, 0.2, 0.05, 0, 0, -3, 0]
    for start in starts:
        states = rolled(study.nominal, start, np.zeros((40, 2)))
        momentum = 0.5 * states[:, 4] + 0.2 * states[:, 6]
        np.testing.assert_allclose(momentum, momentum[0], atol=1e-12)
        assert np.ptp(states[:, 4]) > 0.1  # they have met


def test_a_hopper_in_the_air_flies_as_its_centre_of_mass() -> None:
    """A parabola, and angular momentum about it is kept, whatever the joints do, to the step's order."""
    study = loaded("hopper", torso_mass=4.0, torso_inertia=0.2)
    t = study.task.time_step * np.arange(41)
    inputs = np.stack([5 * np.sin(20 * t), 40 * np.cos(15 * t)], axis=1)[:-1]
    x = rolled(study.nominal, [0, 2, 0.1, 0.2, 0, 0.5, 1, 1, -2, 0], inputs)
    leg, turn = x[:, 2] + x[:, 3], x[:, 7] + x[:, 8]
    along = np.stack([-np.sin(leg), -np.cos(leg)], axis=1)
    across = np.stack([-np.cos(leg), np.sin(leg)], axis=1)
    masses = np.array([4.0, UPPER_MASS, FOOT_MASS])
    places, velocities = [], []
    zero = 0 * leg
    for far, rate in ((zero, zero), (UPPER_CENTRE + zero, zero), (FOOT_CENTRE + x[:, 4], x[:, 9])):
        places.append(x[:, :2] + far[:, None] * along)
        velocities.append(x[:, 5:7] + (far * turn)[:, None] * across + rate[:, None] * along)
    centre, velocity = (np.average(each, axis=0, weights=masses) for each in (places, velocities))
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


VALUES = {"cart_mass": 2.0, "pole_mass": 0.5, "length": 1.2, "cart_damping": 0.3, "hinge_damping": 0.02}
X, U = np.array([0.1, 0.3, -0.4, 0.7]), np.array([1.5])


def energy(x: Array, cart_mass: float, pole_mass: float, length: float) -> Array:
    """In J, of a thin, uniform pole; its centre is half a length above the cart where the angle is zero."""
    _, angle, speed, rate = np.moveaxis(x, -1, 0)
    half = length / 2
    of_pole = (speed + half * rate * np.cos(angle)) ** 2 + (half * rate * np.sin(angle)) ** 2
    kinetic = cart_mass * speed**2 / 2 + pole_mass * of_pole / 2 + pole_mass * length**2 / 24 * rate**2
    return kinetic + pole_mass * 9.81 * half * np.cos(angle)


def test_energy_is_kept_without_damping_and_force() -> None:
    masses = {name: VALUES[name] for name in ("cart_mass", "pole_mass", "length")}
    model, x = CartPole(cart_pole(), **masses), X
    energies = [energy(x, **masses)]
    for _ in range(100):
        x = model.step(x, np.zeros(1))
        energies.append(energy(x, **masses))
    assert abs(x[1]) > 1.0  # it has fallen
    assert np.ptp(energies) < 1e-4 * masses["pole_mass"] * 9.81 * masses["length"]


def test_with_another_value_it_is_the_model_that_is_made_with_it() -> None:
    for name in VALUES:
        changed = VALUES | {name: 1.3 * VALUES[name]}
        model = CartPole(cart_pole(), **VALUES, uncertainty={name: 0.1}).with_parameters(
            np.array([changed[name]])
        )
        np.testing.assert_array_equal(model.step(X, U), CartPole(cart_pole(), **changed).step(X, U))
        assert not np.array_equal(model.step(X, U), CartPole(cart_pole(), **VALUES).step(X, U))


def test_another_task_is_refused() -> None:
    for quantities in ("states", "inputs"):
        task = cart_pole()
        setattr(task, quantities, (*getattr(task, quantities), getattr(task, quantities)[0]))
        with pytest.raises(ValueError, match="expected a task with position, angle and their velocities"):
            CartPole(task, 1.0, 0.1, 1.0)
