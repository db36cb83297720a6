"""The double pendulum: conservation, an independent integration of the published equations, kernels."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

import simbias
from simbias.config import ConfigError, compose
from simbias.config.build import construct
from simbias.core import Nominal, Task
from simbias.core.parameters import values_at
from simbias.core.records import Array
from simbias.learning.identification.identified import Identified
from simbias.learning.identification.possible import MARGIN, nearest_possible
from simbias.robots.double_pendulum import DoublePendulum

UPRIGHT = np.array([np.pi, 0.0, 0.0, 0.0])
FRICTION = {"damping_1": 0.02, "damping_2": 0.01, "friction_1": 0.16, "friction_2": 0.12}


def task(time_step: float = 0.002) -> Task:
    config = compose(["preset=double_pendulum", "tracking=none"]).config["task"]
    return construct({**config, "time_step": time_step}, Task, "task")


TASK = task()


def model(time_step: float = 0.002, **changes: float) -> DoublePendulum:
    config = dict(compose(["preset=double_pendulum", "tracking=none"]).config["nominal"])
    config["drives"] = config["drives"] | changes
    made = construct(config, Nominal, "nominal", task=task(time_step))
    assert isinstance(made, DoublePendulum)
    return made


m_1, l_1, r_1, I_1 = 0.52346, 0.2, 0.2, 0.0318872
m_2, r_2, I_2, g = 0.62557, 0.255693, 0.0508698, 9.81


def inertia(q: Array, rotor: float = 0.0, gear: float = 6.0) -> Array:
    """The inertia matrix (2, 2) at the angles q (2,)."""
    c = np.cos(q[1])
    coupled = I_2 + m_2 * l_1 * r_2 * c - gear * rotor
    return np.array(
        [
            [I_1 + I_2 + m_2 * l_1**2 + 2 * m_2 * l_1 * r_2 * c + (gear**2 + 1) * rotor, coupled],
            [coupled, I_2 + gear**2 * rotor],
        ]
    )


def energy(x: Array) -> float:
    """Kinetic and potential energy in J at x (4,), without rotors."""
    q, v = x[:2], x[2:]
    height = (m_1 * r_1 + m_2 * l_1) * np.cos(q[0]) + m_2 * r_2 * np.cos(q.sum())
    return float(0.5 * v @ inertia(q) @ v - g * height)


def published(x: Array, u: Array, drives: dict[str, float]) -> Array:
    """dx/dt by the equations of the Underactuated Robotics Lab's README, written out with matrices."""
    q, v = x[:2], x[2:]
    s, M = np.sin(q[1]), inertia(q, drives.get("rotor_inertia", 0.0))
    C = m_2 * r_2 * l_1 * s * np.array([[-2 * v[1], -v[1]], [v[0], 0.0]])
    both = np.sin(q.sum())
    G = np.array(
        [-m_1 * g * r_1 * np.sin(q[0]) - m_2 * g * (l_1 * np.sin(q[0]) + r_2 * both), -m_2 * g * r_2 * both]
    )
    b = np.array([drives.get("damping_1", 0.0), drives.get("damping_2", 0.0)])
    c_f = np.array([drives.get("friction_1", 0.0), drives.get("friction_2", 0.0)])
    return np.concatenate([v, np.linalg.solve(M, u + G - C @ v - b * v - c_f * np.arctan(100 * v))])


def rollout(nominal: Nominal, x: Array, u: Array, frames: int) -> Array:
    for _ in range(frames):
        x = nominal.step(x, u)
    return x


def test_a_step_is_the_published_equations() -> None:
    """Of order two, friction included: four times the steps, sixteen times less error."""
    u, duration, start = np.array([0.8, -0.5]), 0.032, np.array([0.4, -0.9, 3.0, -2.0])
    for drives in ({}, FRICTION | {"rotor_inertia": 6e-5}):
        solved = solve_ivp(
            lambda t, x, drives=drives: published(x, u, drives), (0, duration), start, rtol=1e-11, atol=1e-11
        )
        errors = [
            np.abs(rollout(model(h, **drives), start, u, round(duration / h)) - solved.y[:, -1]).max()
            for h in (1e-3, 2.5e-4)
        ]
        assert errors[0] < 2e-4
        assert errors[0] / errors[1] == pytest.approx(16, rel=0.3)


def test_energy_is_kept_without_friction_and_lost_with_it() -> None:
    """Which, where it is stiff, brings it to rest."""
    start = np.array([2.0, 0.5, 0.0, 0.0])
    x, free = start, model()
    for _ in range(10):
        x = rollout(free, x, np.zeros(2), 50)
        assert energy(x) == pytest.approx(energy(start), abs=2e-3)
    assert energy(rollout(model(**FRICTION), start, np.zeros(2), 500)) < energy(start) - 0.2
    stiff = model(0.01, friction_1=2.0, friction_2=2.0)
    at_rest = rollout(stiff, np.array([0.3, 0.2, 1.0, -1.0]), np.zeros(2), 300)
    assert np.abs(at_rest[2:]).max() < 0.02


def test_parameters_are_those_of_the_equations() -> None:
    nominal, x, u = model(), np.array([0.3, 0.2, 1.0, -1.0]), np.array([0.1, 0.2])
    names, values = zip(*((p.name, p.value) for p in nominal.parameters), strict=True)
    assert len(names) == len(set(names)) == 11
    same = nominal.with_parameters(np.array(values))
    np.testing.assert_allclose(same.step(x, u), nominal.step(x, u), rtol=1e-12)
    for name, value in zip(names, values, strict=True):
        changed = nominal.with_parameters(np.where(np.array(names) == name, 2 * value + 0.01, values))
        assert np.abs(changed.step(x, u) - nominal.step(x, u)).max() > 1e-6, name


@pytest.mark.slow
@settings(deadline=None, max_examples=10)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.5), st.floats(0.1, 1.0))
@example(118960, 0.5, 1.0)  # one link gives way to the other, in turns
def test_each_draw_is_of_bodies(seed: int, spread: float, width: float) -> None:
    """Of the prior and of a posterior, however wide: inertias exceed what mass and centre alone give."""
    config = dict(compose(["preset=double_pendulum", "tracking=none"]).config["nominal"])
    spreads = {"masses": spread, "centres": spread, "inertias": spread, "bodies": True}
    nominal = construct({**config, "uncertainty": spreads}, Nominal, "nominal", task=TASK)
    rng, p = np.random.default_rng(seed), len(nominal.parameters)
    root = width * rng.standard_normal((p, p))
    mode = nearest_possible(nominal, rng.standard_normal(p), root)
    identified = Identified(nominal, mode, root, {})
    for drawn in (nominal.draw(rng), identified.model, identified.draw(rng)):
        assert isinstance(drawn, DoublePendulum)
        v = drawn._values
        for i in (1, 2):
            assert v[f"inertia_{i}"] >= v[f"mass_{i}"] * v[f"centre_{i}"] ** 2 > 0


def test_the_nearest_bodies_are_told_by_the_covariance() -> None:
    """Nearest in terms of it, by an optimiser of its own."""
    nominal, rng = model(), np.random.default_rng(0)
    p = len(nominal.parameters)
    z, root = 2.0 * rng.standard_normal(p), rng.standard_normal((p, p))
    names = [parameter.name for parameter in nominal.parameters]
    z[[names.index("inertia_1"), names.index("inertia_2")]] = -4.0

    def slack(at: Array) -> Array:
        return nominal.with_parameters(values_at(nominal.parameters, at)).slack - MARGIN

    assert (slack(z) < 0).all()
    condition = {"type": "ineq", "fun": lambda y: slack(z + root @ y)}
    other = z + root @ minimize(lambda y: y @ y, np.zeros(p), constraints=condition, tol=1e-12).x
    np.testing.assert_allclose(nearest_possible(nominal, z, root), other, atol=1e-4)


@pytest.mark.slow
def test_upright_with_its_elbow_driven_it_is_the_same_pendulum() -> None:
    """The first angle counted from the top, the second torque alone."""
    acrobot = simbias.load(["preset=acrobot", "tracking=none"]).nominal
    x, u = np.random.default_rng(0).normal(0.0, 0.5, (20, 4)), np.linspace(-2.0, 2.0, 20)[:, None]
    hanging = model().step(x + UPRIGHT, np.hstack([np.zeros((20, 1)), u]))
    np.testing.assert_allclose(acrobot.step(x, u) + UPRIGHT, hanging, atol=1e-12)
    with pytest.raises(ConfigError, match="driven=second: expected a task with 4 states and 1 inputs"):
        simbias.load(["preset=double_pendulum", "hardware=pymunk", "nominal.driven=second", "tracking=none"])
