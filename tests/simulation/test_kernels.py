"""Functions of numbers, for vectors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from simbias.simulation.compiler import elementwise, sincos


def law(x, parameters):
    """Something of all that a kernel may do: sines, square roots, quotients, squares."""
    s, c = sincos(x[0])
    return s / x[1], np.sqrt(x[1]) * c, x[0] * x[0] + parameters[0]


@pytest.mark.filterwarnings("ignore:.* encountered in sqrt")  # said of a robot's state, of many not
@given(arrays(float, 2, elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_a_vector_alone_is_a_row_of_many(x: np.ndarray) -> None:
    """To the last bit, also where it divides by zero or overflows: Python's numbers would raise there."""
    alone = elementwise(law, x, parameters=np.array([0.5]))
    np.testing.assert_array_equal(alone, elementwise(law, x[None], parameters=np.array([0.5]))[0])
