"""Equations that robots ship with, compiled: the same step as in NumPy, whatever is identified."""

import numpy as np
import pytest
from in_lanes import from_python
from shipped import overrides

import simbias
from simbias.config import options


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::simbias.core.StudyWarning")
def test_a_model_with_other_parameters_steps_as_in_numpy() -> None:
    compared = []
    for name in options()["nominal"]:
        study = simbias.load([*overrides("nominal", name), "tracking=none"]).without_targets
        rng, nominal = np.random.default_rng(0), study.nominal
        if nominal.kernel is None or not nominal.parameters:
            continue
        model = nominal.with_parameters(np.array([parameter.value for parameter in nominal.parameters]))
        x = study.task.start_mean + 0.01 * rng.standard_normal(len(study.task.states))
        u, memory = 0.1 * rng.standard_normal(len(study.task.inputs)), np.zeros(model.state_size)
        rows = [tuple(row.tolist()) for row in (x, u, model.kernel.parameters, memory)]
        stepped = from_python(model.kernel.function)(*rows[: 3 + bool(memory.size)])
        stepped = stepped[0] if memory.size else stepped
        np.testing.assert_allclose(stepped, model.advance(x, u, memory)[0], atol=1e-12, err_msg=name)
        compared.append(name)
    assert {"bongoboard", "bongoboard_gaps", "double_pendulum", "reacher"} <= {*compared}
