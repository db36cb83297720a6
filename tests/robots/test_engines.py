"""The bongoboard in other engines: against the Lagrangian model, and against each other."""

from typing import Any

import numpy as np
import pytest
from bongoboard_twin import MOVING, START, UNLIMITED, build_task, build_twin, experiment

from simbias.core import HardwareError
from simbias.policy.output_feedback import OutputFeedback
from simbias.robots.bongoboard.box2d import UNIT, Box2dBongoboard
from simbias.robots.bongoboard.model import LagrangianBongoboard
from simbias.robots.bongoboard.mujoco import MujocoBongoboard
from simbias.robots.bongoboard.pymunk import PymunkBongoboard
from simbias.simulation.control_loop import BLOW_UP

ENGINES: tuple[Any, ...] = (Box2dBongoboard, MujocoBongoboard)
BALANCING = np.array([9.92, 6.37, -8.36, -4.38, 5.77])  # found on the hardware in pymunk


def test_a_frame_is_the_lagrangian_step() -> None:
    """For 0.1 s, as single precision and soft contacts allow; later, all is fast and contacts jump."""
    model = LagrangianBongoboard(build_task(), foot_mass=1.0)
    for engine, median in ((Box2dBongoboard, 1e-5), (MujocoBongoboard, 2e-4)):
        world = engine(build_task()).build(MOVING)
        np.testing.assert_allclose(world.state(), MOVING, atol=1e-6)
        states = experiment(engine(build_twin(horizon=100)), 5.0).states  # type: ignore[arg-type]
        errors = np.abs(states[1:] - model.step(states[:-1], np.array([5.0])))
        assert np.median(errors.max(axis=1)) < median
        assert errors.max() < 0.02


def test_energy_is_kept() -> None:
    """Falling turns 0.42 J into motion."""
    for engine in ENGINES:
        task = build_task(UNLIMITED)
        world, energies = engine(task).build(START), []
        for _ in range(150):
            world.step(0.0)
            energies.append(_energy(world, task.robot.gravity))
        assert np.ptp(energies) < 0.02 * 0.42


def test_a_heavier_robot_with_a_stronger_torque_moves_alike() -> None:
    task = build_task(horizon=100)
    for engine in (PymunkBongoboard, *ENGINES):
        one, other = (experiment(engine(task, error), (1 + error) * 5.0).states for error in (0.0, 0.2))
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-8 if engine is PymunkBongoboard else 2e-3)
        assert np.abs(experiment(engine(task, 0.2), 5.0).states - one).max() > 0.01


@pytest.mark.slow
def test_failures_are_the_tasks() -> None:
    task = build_task(UNLIMITED)
    for engine in (PymunkBongoboard, *ENGINES):
        assert experiment(engine(task), 5.0).failure == "board_touches_ground"
        assert experiment(engine(build_task()), 0.0).failure == "body_angle"
        blown_up = experiment(engine(task), 1e8)
        assert (blown_up.failure, blown_up.failed_at) == (BLOW_UP, 0)
        np.testing.assert_array_equal(blown_up.states, [START])
        rollout = experiment(engine(build_task()), 0.0, np.array([0.0, 0.05, 1.2, 0.0, 0.0, 0.0]))
        assert (rollout.failure, rollout.failed_at) == ("body_angle", 0)
        with pytest.raises(HardwareError, match="cannot start"):
            experiment(engine(build_task()), 0.0, np.full(6, np.nan))


def test_an_experiment_is_determined_by_its_seed() -> None:
    for engine in ENGINES:
        hardware = engine(build_task(horizon=30), noise={"torque_variance": 0.1})
        one, other, third = (experiment(hardware, 0.0, seed=seed).states for seed in (0, 0, 1))
        np.testing.assert_array_equal(one, other)
        assert not np.array_equal(one, third)


@pytest.mark.slow
def test_a_policy_that_balances_one_engine_balances_the_others() -> None:
    task = build_task(horizon=2000)  # without torque, it falls within 0.7 s
    for engine in (PymunkBongoboard, *ENGINES):
        made = engine(task).run(OutputFeedback(task), BALANCING, START, np.random.default_rng(0))
        assert made.failure is None


def _energy(world: Any, gravity: float) -> float:
    """Kinetic and potential energy in J of all bodies."""
    if hasattr(world, "bodies"):
        return sum(
            0.5 * body.mass * (body.linearVelocity[0] ** 2 + body.linearVelocity[1] ** 2) * UNIT**2
            + 0.5 * (body.massData.I * UNIT**2) * body.angularVelocity**2
            + body.mass * gravity * body.position.y * UNIT
            for body in world.bodies.values()
        )
    from simbias.robots.mujoco.parameters import mujoco

    mujoco().mj_energyPos(world._model, world.data)
    mujoco().mj_energyVel(world._model, world.data)
    return float(world.data.energy.sum())
