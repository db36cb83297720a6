"""Intervals of shares, against SciPy's; priors as functions of normal coordinates."""

import numpy as np
import pytest
from scipy import stats
from scipy.stats import binomtest

from simbias.core.parameters import Parameter, values_at
from simbias.core.proportions import clopper_pearson, counted_share, wilson


def test_intervals_are_scipys() -> None:
    for n in (1, 2, 7, 20, 240):
        for k in range(0, n + 1, max(1, n // 9)):
            test = binomtest(k, n)
            assert wilson(k, n) == pytest.approx(test.proportion_ci(0.95, "wilson"), abs=1e-12)
            for confidence, bounds in ((0.9, clopper_pearson(k, n, 0.9)), (0.95, clopper_pearson(k, n))):
                assert bounds == pytest.approx(test.proportion_ci(confidence, "exact"), abs=1e-9)
    assert np.isnan([*wilson(0, 0), *clopper_pearson(0, 0)]).all()
    assert counted_share(0, 20) == "0 of 20 (0% to 16%)"
    assert counted_share(0, 0) == "0 of 0"


lognorm = stats.lognorm(0.3, scale=2.0)
PRIORS = {
    "normal": (Parameter("slope", "rad", 0.1, 0.05), stats.norm(0.1, 0.05).ppf),
    "log_normal": (Parameter("mass", "kg", 2.0, 0.3, "log_normal"), lognorm.ppf),
    "negative": (Parameter("offset", "m", -2.0, 0.3, "log_normal"), lambda q: -lognorm.isf(q)),
    "half_normal": (Parameter("damping", "N m s", 0.0, 0.4, "half_normal"), stats.halfnorm(0.0, 0.4).ppf),
    "uniform": (Parameter("foot mass", "kg", 0.5, 2.0, "uniform"), stats.uniform(0.5, 2.0).ppf),
}


def test_coordinates_are_quantiles_of_the_prior() -> None:
    """Far from it nothing overflows; values keep leading axes."""
    z = np.linspace(-6.0, 6.0, 49)
    for parameter, quantiles in PRIORS.values():
        np.testing.assert_allclose(parameter.at(z), quantiles(stats.norm.cdf(z)), rtol=1e-6, atol=1e-9)
        assert (np.diff(parameter.at(z)) > 0).all()
        with np.errstate(all="raise", under="ignore"):
            assert np.isfinite(parameter.at(np.array([-1e6, -50.0, 50.0, 1e6]))).all()
    parameters = [parameter for parameter, _ in PRIORS.values()]
    z = np.random.default_rng(0).normal(size=(3, 5, len(parameters)))
    values = values_at(parameters, z)
    assert values.shape == z.shape
    np.testing.assert_array_equal(values[1, 2], values_at(parameters, z[1, 2]))
