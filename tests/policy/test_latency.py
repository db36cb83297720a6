"""Policies that act on the state that their input will meet."""

import numpy as np
import pytest

import simbias
from simbias.core.errors import ConfigError
from simbias.core.records import Array
from simbias.policy.observer import LookAhead, Measured
from simbias.trial.study import Study

BOARD = ["preset=acrobot_board", "policy.latency=0", "policy.input_weight=100", "tracking=none"]


def board(*overrides: str) -> Study:
    return simbias.load([*BOARD, *overrides])


def test_it_sees_most_of_what_happens_while_measurements_are_late() -> None:
    """Four frames late: of what moves in them a tenth is missed, by one step of the model."""
    study, rng = board(), np.random.default_rng(0)
    task, nominal = study.task, study.nominal
    observer = LookAhead(task, nominal, Measured(task, nominal), 4 * task.time_step)
    missed = []
    for _ in range(20):
        path = [rng.normal(0.0, [1.0, 1.0, 3.0, 3.0])]
        kept, u = np.zeros(observer.size), rng.uniform(-2.0, 2.0, (4, 1))
        for each in u:
            kept = observer.keep(path[0], path[0], each, kept)
            path.append(nominal.step(path[-1], each))
        wrong = observer.ahead(observer.estimate(np.empty(0), path[0], 1.0, kept), kept) - path[-1]
        missed.append(np.linalg.norm(wrong) / np.linalg.norm(path[-1] - path[0]))
    assert np.median(missed) < 0.1
    assert max(missed) < 0.5


def tip(study: Study, late: int) -> Array:
    """How far (t,) an acrobot that begins near the top is from it, when measurements are some frames late."""
    theta = np.append(np.zeros(study.policy.n_parameters - 1), 3.0)  # its regulator, wherever it is
    theta[-2] = 1.0  # rates as positions tell them
    states, kept = [np.array([0.002, 0.0, 0.0, 0.0])], np.zeros(study.policy.state_size)
    for t in range(400):
        measured = states[max(t - late, 0)]
        u, kept = study.policy.act(theta, measured, t * study.task.time_step, kept)
        states.append(study.nominal.step(states[-1], u))
    return np.abs(np.array(states)).max(axis=1)


def test_a_regulator_bears_later_measurements() -> None:
    plain, ahead = board(), board("policy.latency=0.016")
    assert tip(plain, 0)[-50:].max() < 0.03
    assert tip(plain, 6)[-50:].max() > 1.0  # 24 ms
    assert tip(ahead, 6)[-50:].max() < 0.03
    assert tip(ahead, 0)[-50:].max() < 0.03  # nor do they have to be late


def test_later_than_it_can_remember_is_one_line() -> None:
    with pytest.raises(ConfigError, match=r"latency: expected at most 20 frames, 0\.08 s, got 0\.1 s"):
        board("policy.latency=0.1")
