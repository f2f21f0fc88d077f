import numpy as np
import pytest

from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.spectral_colour import (
    DAYLIGHT,
    OBSERVER,
    WAVELENGTHS,
    XYZ_TO_REC709,
    rgb_weights,
)


def test_daylight_is_the_white_of_rec709():
    """x = 0.3127 and y = 0.3290, the chromaticity that the tables are known by."""
    xyz = DAYLIGHT @ OBSERVER
    np.testing.assert_allclose(xyz[:2] / xyz.sum(), [0.3127, 0.3290], atol=5e-4)
    white = XYZ_TO_REC709 @ (xyz / xyz[1])
    np.testing.assert_allclose(white, 1.0, atol=3e-3)
    # twin: equal energy is another white
    flat = OBSERVER.sum(axis=0)
    assert abs(flat[0] / flat.sum() - 0.3127) > 0.01


def test_equal_energy_has_equal_tristimulus_values():
    """The observer's functions have the same integral, 106.86 at 1 nm."""
    np.testing.assert_allclose(OBSERVER.sum(axis=0) * 10, 106.86, rtol=5e-3)


def test_primaries_of_rec709_come_back():
    """The matrix sends the chromaticities of the primaries to unit vectors."""
    for channel, (x, y) in enumerate([(0.64, 0.33), (0.30, 0.60), (0.15, 0.06)]):
        rgb = XYZ_TO_REC709 @ np.array([x / y, 1.0, (1 - x - y) / y])
        rest = np.delete(rgb, channel)
        assert rgb[channel] > 1.0
        np.testing.assert_allclose(rest / rgb[channel], 0.0, atol=1e-3)


@pytest.mark.parametrize(
    "waves", [WAVELENGTHS, np.arange(380.0, 781.0, 5.0), np.array([450.0, 650.0])]
)
def test_a_grey_is_grey(waves):
    np.testing.assert_allclose(np.full(len(waves), 0.4) @ rgb_weights(waves), 0.4, rtol=1e-12)


def test_hues_are_told_apart():
    weights = rgb_weights(WAVELENGTHS)
    for band, channel in (((600, 700), 0), ((500, 570), 1), ((400, 480), 2)):
        spectrum = ((band[0] <= WAVELENGTHS) & (band[1] >= WAVELENGTHS)).astype(float)
        rgb = spectrum @ weights
        assert rgb.argmax() == channel
        assert rgb[channel] > 0.5


def test_denser_wavelengths_of_a_smooth_spectrum_agree():
    def spectrum(w):
        return 0.5 + 0.4 * np.sin(w / 60.0)

    dense = np.arange(380.0, 731.0, 2.0)
    plain = spectrum(dense) @ rgb_weights(dense)
    np.testing.assert_allclose(spectrum(WAVELENGTHS) @ rgb_weights(WAVELENGTHS), plain, atol=2e-3)


def test_too_few_wavelengths_are_refused():
    with pytest.raises(BrdfError, match="span 500 to 700 nm"):
        rgb_weights(np.array([500.0, 700.0]))
    with pytest.raises(BrdfError, match="do not rise"):
        rgb_weights(np.array([400.0, 700.0, 600.0]))
