"""Shapes are the contracts' wherever components are called, and one that is not is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from in_numpy import by_value
from shipped import overrides

import simbias
from simbias.config import options
from simbias.core import SlowWarning
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.testing.expectations import ConformanceError
from simbias.testing.shapes import watch
from simbias.trial.run import Outcome, run_trial
from simbias.trial.study import Study

SHORT = ["tracking=none", "task.horizon=60", "optimizer.max_evaluations=40", "method.max_iterations=2"]
CHOICES = [
    (group, option)
    for group, names in options().items()
    if group in ("preset", "policy", "nominal", "bias", "evaluation", "samples")
    for option in names
]


def trial_in_numpy(study: Study) -> Outcome:
    """How a trial ends whose searches are simulated in NumPy, so that every method is called."""
    plain = replace(study, nominal=watch(study).nominal)
    plain.nominal.kernel = None
    for name in ("step", "advance"):
        setattr(plain.nominal, name, by_value(getattr(plain.nominal, name)))
    return run_trial(watch(plain)).outcome


@pytest.mark.slow
@pytest.mark.filterwarnings(f"ignore::{SlowWarning.__module__}.{SlowWarning.__name__}")
@pytest.mark.parametrize(("group", "option"), CHOICES)
def test_every_shipped_component_keeps_to_its_shapes(group: str, option: str) -> None:
    assert trial_in_numpy(simbias.load([*overrides(group, option), *SHORT])).final


@pytest.mark.filterwarnings(f"ignore::{SlowWarning.__module__}.{SlowWarning.__name__}")
def test_a_plain_component_of_ones_own_keeps_to_its_shapes() -> None:
    assert trial_in_numpy(simbias.load([*POINT_MASS, *SHORT], OWN_CONF)).final


@pytest.mark.parametrize(
    ("component", "method", "broken", "message"),
    [
        (
            "nominal",
            "step",
            lambda x, u: x.T,
            r"step: expected x_next \(\.\.\., n\) with n = 6, got the shape",
        ),
        (
            "nominal",
            "step",
            lambda x, u: x[:1],
            r"step: expected leading axes \(4,\) of its arguments, got \(1,\)",
        ),
        ("task", "measure", lambda x: x[..., 0], r"measure: expected measures \(\.\.\., c\) with c = 6"),
        (
            "policy",
            "act",
            lambda theta, x, t, policy_state: x[..., :1],
            r"act: expected 2 arrays: u, policy_state, got 4",
        ),
    ],
)
def test_a_wrong_shape_is_named(study: Study, component: str, method: str, broken, message: str) -> None:
    changed = watch(study)
    vars(getattr(changed, component))[method] = broken
    twice = watch(changed)
    model = twice.model()
    model.nominal.kernel = None
    thetas, starts = np.zeros((4, 5)), np.tile(study.task.start_mean, (4, 1))
    with pytest.raises(ConformanceError, match=message):
        PlainSimulator([model], [None]).rollouts(thetas, starts)
