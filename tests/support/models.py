"""Models with other values of their parameters."""

from typing import Any

import numpy as np


def with_values(model: Any, **values: float) -> Any:
    """The model with these parameters, all else as it was declared."""
    known = {parameter.name: parameter.value for parameter in model.parameters}
    assert values.keys() <= known.keys()
    return model.with_parameters(np.array(list((known | values).values())))
