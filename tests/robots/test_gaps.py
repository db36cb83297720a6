"""Each gap of the hardware against theory, and against the nominal model with the same parameter."""

import numpy as np
import pytest
from bongoboard_twin import MOVING, START, Constant, build_task, build_twin, energy, experiment, runge_kutta
from models import with_values

from simbias.core.records import Array
from simbias.robots.bongoboard.gaps import Gaps
from simbias.robots.bongoboard.model import LagrangianBongoboard, Uncertainty
from simbias.robots.bongoboard.pymunk import PymunkBongoboard

DURATION = 0.15  # s
PAYLOAD = {"payload_mass": 5.0, "payload_x": 0.1, "payload_y": 0.2}
KNOWN = [
    {"slope": 0.05},
    {"ankle_damping": 2.0},
    {"ankle_stiffness": 40.0},
    PAYLOAD,
    {"motor_gain": 0.4},
    {"torque_offset": 3.0},
    {"lag": 0.03},
    {"delay": 0.03},
]


def exact(values: dict[str, float], torque: float) -> Array:
    """State (6,) of the nominal model that knows these values, by the fourth-order method."""
    model = LagrangianBongoboard(
        build_task(), foot_mass=1.0, uncertainty=Uncertainty(**dict.fromkeys(values, 1e-2))
    )
    model = with_values(model, **values)
    gain, offset = values.get("motor_gain", 1.0), values.get("torque_offset", 0.0)
    lag, delay = values.get("lag", 0.0), values.get("delay", 0.0)

    def accelerations(t: float, x: Array) -> Array:
        late = max(0.0, t - delay)
        acts = gain * torque * ((1.0 - np.exp(-late / lag)) if lag else t >= delay - 1e-9) + offset
        return model.accelerations(x, np.array([acts]))

    return runge_kutta(accelerations, START, DURATION, 300)[-1]


def hardware(frames: int = 150, **gaps: float) -> PymunkBongoboard:
    """A twin of the nominal model with gaps, that runs for so many frames of `DURATION`."""
    task = build_twin(DURATION / frames, horizon=frames)
    if "delay" in gaps:
        gaps["delay"] = round(gaps["delay"] / task.time_step)
    return PymunkBongoboard(task, feet="fixed", overlap=0.1 * task.time_step, gaps=Gaps(**gaps))


@pytest.mark.slow
def test_trajectory_converges_to_that_of_the_nominal_model_that_knows_the_gap() -> None:
    """With order one, as without gaps; and the gap matters more than the error."""
    without = exact({"slope": 0.0}, 5.0)
    for values in KNOWN:
        reference = exact(values, 5.0)
        errors = [
            np.linalg.norm(experiment(hardware(frames, **values), 5.0).states[-1] - reference)
            for frames in (150, 300)
        ]
        assert errors[0] < 0.04, values
        assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.05), values
        assert np.linalg.norm(without - reference) > 20 * errors[0], values


def powers(hardware: PymunkBongoboard) -> tuple[Array, Array]:
    """Energy (k+1,) in J and states (k+1, 6) without torque."""
    world, task = hardware.build(MOVING), hardware.task
    energies, states = [energy(world, task.robot.gravity)], [world.state()]
    for _ in range(task.horizon):
        world.step(0.0)
        energies.append(energy(world, task.robot.gravity))
        states.append(world.state())
    return np.array(energies), np.array(states)


def test_losses_take_what_they_should_from_the_energy() -> None:
    """To the engine's own error of energy, which is of order one."""
    own_error = np.ptp(powers(hardware(600))[0])
    for name in ("ankle_damping", "ankle_friction", "rolling_resistance"):
        energies, states = powers(hardware(600, **{name: 1.0}))
        rates = states[:, 3 if name == "rolling_resistance" else 5]
        lost = np.trapezoid(rates**2 if name == "ankle_damping" else np.abs(rates), dx=DURATION / 600)
        assert lost > 5 * own_error
        assert energies[0] - energies[-1] == pytest.approx(lost, abs=2 * own_error, rel=0.02)


def test_friction_sticks_up_to_its_strength() -> None:
    """The ankle holds where the torque is below it, and slips where it is above."""
    still = np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0])
    held, slips = (experiment(hardware(ankle_friction=strength), 5.0, still) for strength in (40.0, 1.0))
    assert np.abs(held.states[:, 2]).max() < 1e-4
    assert np.abs(slips.states[:, 2]).max() > 0.05


def test_what_the_motor_does_to_a_torque() -> None:
    task = build_task(horizon=40)
    expected = experiment(PymunkBongoboard(task), 5.0).states
    for torque, gaps in (
        (6.0, Gaps(motor_gain=0.5, torque_offset=2.0)),
        (20.0, Gaps(motor_gain=0.5, torque_limit=3.0, torque_offset=2.0)),
    ):
        states = experiment(PymunkBongoboard(task, gaps=gaps), torque).states
        np.testing.assert_array_equal(states, expected)


def test_a_delay_is_exact_in_frames() -> None:
    class Late(Constant):
        def act(self, theta, x, t, memory):  # type: ignore[no-untyped-def]
            return theta * (t >= 6.5e-3), memory

    task = build_task(horizon=40)
    delayed = experiment(PymunkBongoboard(task, gaps=Gaps(delay=7)), 5.0)
    late = PymunkBongoboard(task).run(Late(), np.array([5.0]), START, np.random.default_rng(0))
    np.testing.assert_array_equal(delayed.states, late.states)
    np.testing.assert_array_equal(delayed.inputs, 5.0)  # as commanded


def test_a_sensor_is_late_and_off() -> None:
    gaps = Gaps(sensor_offset={"theta": 0.1, "d_theta": -0.2}, sensor_delay=3)
    for record in ("true_state", "measured"):
        rollout = experiment(PymunkBongoboard(build_task(horizon=40), record=record, gaps=gaps), 5.0)
        truth = experiment(PymunkBongoboard(build_task(horizon=40)), 5.0).states
        seen = truth[np.maximum(0, np.arange(41) - 3)] + [0.0, 0.0, 0.1, 0.0, 0.0, -0.2]
        assert rollout.measured is not None
        np.testing.assert_allclose(rollout.measured, seen, rtol=0, atol=1e-15)
        np.testing.assert_array_equal(rollout.states, truth if record == "true_state" else rollout.measured)


def test_an_offset_of_no_state_is_named() -> None:
    with pytest.raises(ValueError, match="no state is called phi; available: alpha_w"):
        PymunkBongoboard(build_task(), gaps=Gaps(sensor_offset={"phi": 0.1}))


def test_backlash_has_a_dead_zone() -> None:
    """A rotor of inertia J crosses half the play b in sqrt(J b / u); then it takes the leg with it."""
    play, torque, inertia = 0.04, 2.0, 0.01
    world = hardware(backlash=play, rotor_inertia=inertia).build(np.zeros(6))
    rotor, leg = world.bodies["left rotor"], world.bodies["left leg"]
    free, apart = torque / inertia * 0.001, []
    for frame in range(60):
        world.step(torque)
        apart.append(rotor.angle - leg.angle)
        if max(apart) < 0.9 * play / 2:
            assert rotor.angular_velocity == pytest.approx(free * (frame + 1), rel=1e-9)
    assert np.sqrt(inertia * play / torque) / 0.001 == pytest.approx(np.argmax(apart), abs=4)
    assert max(apart) == pytest.approx(play / 2, rel=0.05)
    assert rotor.angular_velocity == pytest.approx(leg.angular_velocity, rel=0.05)
