"""Priors of physical parameters as functions of standard normal coordinates."""

import numpy as np
from scipy import stats

from simbias.core.parameters import Parameter, values_at

PRIORS = {
    "normal": (Parameter("slope", "rad", 0.1, 0.05), stats.norm(0.1, 0.05)),
    "log_normal": (Parameter("mass", "kg", 2.0, 0.3, "log_normal"), stats.lognorm(0.3, scale=2.0)),
    "half_normal": (Parameter("damping", "N m s", 0.0, 0.4, "half_normal"), stats.halfnorm(0.0, 0.4)),
    "uniform": (Parameter("foot mass", "kg", 0.5, 2.0, "uniform"), stats.uniform(0.5, 2.0)),
}


def test_coordinates_are_quantiles_of_the_prior() -> None:
    """Far from it nothing overflows; values keep leading axes."""
    z = np.linspace(-6.0, 6.0, 49)
    for parameter, prior in PRIORS.values():
        np.testing.assert_allclose(parameter.at(z), prior.ppf(stats.norm.cdf(z)), rtol=1e-6, atol=1e-9)
        with np.errstate(all="raise", under="ignore"):
            assert np.isfinite(parameter.at(np.array([-1e6, -50.0, 50.0, 1e6]))).all()
    parameters = [parameter for parameter, _ in PRIORS.values()]
    z = np.random.default_rng(0).normal(size=(3, 5, 4))
    values = values_at(parameters, z)
    assert values.shape == z.shape
    np.testing.assert_array_equal(values[1, 2], values_at(parameters, z[1, 2]))
