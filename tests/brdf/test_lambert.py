import numpy as np

from prtbake_workers.brdf.checks import directional_albedo
from prtbake_workers.brdf.lambert import Lambert


def test_albedo_is_the_albedo_at_every_angle():
    albedo = np.array([0.7, 0.2, 0.1])
    got = directional_albedo(Lambert(albedo), np.array([1e-6, 0.1, 0.5, 1.0]))
    # Gauss quadrature of a polynomial: exact up to rounding
    np.testing.assert_allclose(got, np.tile(albedo, (4, 1)), rtol=1e-12)
    # twin: without the 1 / pi it would be another number
    assert np.abs(got - np.pi * albedo).min() > 0.1
