import numpy as np
import pytest

from prtbake_storage.contract.brdf import CookTorranceSpec
from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.brdf.scattered_text import is_scattered_text, read_scattered_text
from prtbake_workers.brdf.spectral_colour import rgb_weights
from support.scattered_file import (
    WAVES,
    alta_text,
    direction,
    goniometer,
    grey_samples,
    spectral_text,
)

ANGLES = goniometer(4, 5)
BRDF = brdf_from_spec(CookTorranceSpec(m=0.5))
GREY = grey_samples(BRDF, *ANGLES)
HEAD = "2\n400 700\n"


def test_spectral_rows_come_back():
    spectra = GREY[:, None] * np.linspace(0.5, 1.5, len(WAVES))
    found = read_scattered_text(spectral_text(*ANGLES, spectra))
    np.testing.assert_allclose(found.values, spectra @ rgb_weights(WAVES), rtol=1e-8)
    wi, wo = direction(ANGLES[0], 0 * ANGLES[0]), direction(ANGLES[1], ANGLES[2])
    np.testing.assert_allclose(found.wi, wi, atol=1e-8)
    np.testing.assert_allclose(found.wo, wo, atol=1e-8)
    assert found.facts["n_samples"] == len(GREY)
    assert found.facts["n_lights"] == 4
    assert found.facts["wavelengths_nm"] == [400.0, 700.0]
    assert found.facts["max_theta_deg"] == pytest.approx(80.0)


@pytest.mark.parametrize("output", ["INV_STERADIAN", "INV_STERADIAN_COSINE_FACTOR"])
def test_alta_rows_come_back_without_the_cosine(output):
    stored = GREY * np.cos(ANGLES[1]) if "COSINE" in output else GREY
    found = read_scattered_text(alta_text(*ANGLES, stored, output))
    np.testing.assert_allclose(found.values[:, 1], GREY, rtol=1e-8)
    np.testing.assert_allclose(found.wo, direction(ANGLES[1], ANGLES[2]), atol=1e-8)
    assert found.facts["kind"] == "alta"
    assert found.facts["sample"] == "plain"


def test_three_outputs_are_three_channels():
    rgb = GREY[:, None] * np.array([1.0, 0.5, 0.25])
    found = read_scattered_text(alta_text(*ANGLES, rgb, "INV_STERADIAN", "3 3"))
    np.testing.assert_allclose(found.values, rgb, rtol=1e-8)


def test_a_single_wavelength_is_grey():
    found = read_scattered_text(spectral_text(*ANGLES, GREY, np.array([633.0])))
    np.testing.assert_allclose(found.values, np.repeat(GREY[:, None], 3, axis=1), rtol=1e-8)


def test_what_is_left_out_is_counted():
    theta_i, theta_o, dphi = (angle.copy() for angle in ANGLES)
    values = GREY.copy()
    values[3] = -0.1
    theta_o[[5, 6]] = np.pi / 2
    found = read_scattered_text(alta_text(theta_i, theta_o, dphi, values, "INV_STERADIAN"))
    assert len(found.values) == len(values) - 3
    assert (found.facts["n_negative"], found.facts["n_at_horizon"]) == (1, 2)
    assert (found.values >= 0.0).all()


def test_colours_beyond_rec709_are_cut_and_counted():
    spectra = np.zeros((len(GREY), len(WAVES)))
    spectra[:, 4] = 1.0  # 480 nm alone: red and green would be negative or none
    found = read_scattered_text(spectral_text(*ANGLES, spectra))
    assert found.facts["n_outside_gamut"] == len(GREY)
    assert (found.values >= 0.0).all()
    assert (found.values[:, 2] > 0.0).all()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "first number, 0, is no count"),
        ("# nothing", "first number, 0, is no count"),
        ("0\n", "is no count of wavelengths"),
        ("2.5\n400 700\n", "2.5, is no count"),
        ("1e9\n", "1e.09, is no count"),
        ("31\n400 410", "ends within its 31 wavelengths"),
        (HEAD, "has no rows"),
        (HEAD + "0.1 0 0.2 0 1", "hold 6 numbers each, but 5 are left over"),
        (HEAD + "0.1 0 0.2 0 1 one", "line 3: 'one' is no number"),
        (HEAD + "0.1 0 0.2 0 1 nan", "row 1, column 6: nan"),
        (HEAD + "0.1 0 0.2 0 1 1\n50 0 0.2 0 1 1", "row 2: 50 is no angle of the light"),
        (HEAD + "0.1 0 -0.2 0 1 1", "-0.2 is no angle of the view"),
        (HEAD + "0.1 0 0.2 0 1e12 1e12", "row 1: 1e.12 exceeds"),
        (HEAD + "0.1 0 0.2 0 -1 -1", "no sample is left"),
        ("2\n700 400\n0.1 0 0.2 0 1 1", "do not rise"),
        ("#DIM 2 1\n#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI\n0 0 1", "#DIM 2 1"),
        ("#DIM 3 1\n#VS 1\n#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI\n0 0 0 1", "#VS 1"),
        ("#DIM 3 1\n#PARAM_IN RUSIN_TH_TD_PD\n0 0 0 1", "RUSIN_TH_TD_PD is not read"),
        (
            "#DIM 3 1\n#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI\n#PARAM_OUT RGB\n0 0 0 1",
            "RGB is none of",
        ),
    ],
    ids=range(19),
)
def test_a_refusal_says_what_and_where(text, says):
    with pytest.raises(BrdfError, match=says):
        read_scattered_text(text.encode())


def test_truncation_shows_as_a_row_that_is_not_whole():
    whole = spectral_text(*ANGLES, GREY)
    with pytest.raises(BrdfError, match="left over"):
        read_scattered_text(whole[: len(whole) // 2])


def test_it_is_known_by_a_comment_or_a_number():
    assert is_scattered_text(b"# num wls\n31")
    assert is_scattered_text(b"\n 31\n400")
    for other in (b'{"model": 1}', b"name,kD_r", b"\x5a\0\0\0", b"\x89HDF", b"", b"#\xff"):
        assert not is_scattered_text(other)
