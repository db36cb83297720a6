"""A pole on a cart, against mechanics."""

import numpy as np
import pytest
from mechanisms import cart_pole

from simbias.core.records import Array
from simbias.robots.cartpole import CartPole

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
