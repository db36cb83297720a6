"""Models with other values of their parameters, and what they do under inputs."""

from typing import Any

import numpy as np

from simbias.core import Nominal
from simbias.core.records import Array


def with_values(model: Any, **values: float) -> Any:
    """The model with these parameters, all else as it was declared."""
    known = {parameter.name: parameter.value for parameter in model.parameters}
    assert values.keys() <= known.keys()
    return model.with_parameters(np.array(list((known | values).values())))


def driven(model: Nominal, start: Array, inputs: Array) -> Array:
    """Its states (k + 1, n) under inputs (k, m)."""
    states, memory = [start], np.zeros(model.state_size)
    for u in inputs:
        x, memory = model.advance(states[-1], u, memory)
        states.append(x)
    return np.array(states)
