import numpy as np
import pytest

from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.half_difference_table import bin_angles, bins_above_horizon
from prtbake_workers.brdf.merl import FILE_BYTES, is_merl, read_merl
from prtbake_workers.brdf.registry import brdf_from_spec
from support.merl_file import COLOURED, bin_directions, coloured_samples, merl_bytes


@pytest.fixture(scope="module")
def read():
    return read_merl(merl_bytes(coloured_samples()))


def test_the_size_is_that_of_the_description():
    assert FILE_BYTES == 34_992_012
    assert len(merl_bytes(coloured_samples())) == FILE_BYTES


def test_samples_come_back_in_their_bins(read):
    """Channel scales, order of the axes, and the bins' angles."""
    table, report = read
    samples = coloured_samples()
    above = samples.min(axis=0) >= 0
    np.testing.assert_allclose(
        table.values[above[:, :, :90]], np.moveaxis(samples[:, :, :, :90], 0, -1)[above[:, :, :90]],
        rtol=1e-6,
    )  # fmt: skip
    assert report.n_invalid_above_horizon == 0
    assert report.n_above_horizon == above.sum()
    assert report.n_invalid == (~above).sum()
    assert report.n_samples == 1_458_000
    assert report.asymmetry < 1e-12
    assert report.most_negative < 0.0


def test_the_table_is_the_model_it_was_made_of(read, directions):
    table, _ = read
    model = brdf_from_spec(COLOURED)
    wi, wo = directions(20_000), directions(20_000, seed=2)
    weight = (wi[:, 2] * wo[:, 2])[:, None]
    exact, got = model.eval_brdf(wi, wo) * weight, table.eval_brdf(wi, wo) * weight
    # interpolation between 90 x 90 x 90 bins: 6.5e-4 measured
    assert np.linalg.norm(got - exact) < 1.5e-3 * np.linalg.norm(exact)
    # twin: exchanged channels
    assert np.linalg.norm(got[:, ::-1] - exact) > 0.1 * np.linalg.norm(exact)


def test_half_a_turn_is_folded_onto_a_quarter():
    """phi_d and pi - phi_d are mirror images: averaged, and the difference reported."""
    samples = coloured_samples().copy()
    samples[:, :, :, 90:] *= 1.1
    table, report = read_merl(merl_bytes(np.where(samples < 0, -1.0, samples)))
    above = coloured_samples().min(axis=0)[:, :, :90] >= 0
    want = 1.05 * np.moveaxis(coloured_samples()[:, :, :, :90], 0, -1)
    np.testing.assert_allclose(table.values[above], want[above], rtol=1e-6)
    assert report.asymmetry == pytest.approx(0.05 / 1.05, rel=1e-6)


def test_below_the_horizon_is_filled_from_above(read):
    """Nothing is 0 or -1 beside the horizon, so grazing light is not darkened."""
    table, _ = read
    above = bins_above_horizon(90, 90, 90)
    edge = ~above[:, 1:] & above[:, :-1]
    assert edge.any()
    below, beside = table.values[:, 1:][edge], table.values[:, :-1][edge]
    assert (below > 0).all()
    # the nearest bin may lie across, but is never far
    assert np.median(np.abs(below / beside - 1)) < 0.05


def test_bins_are_where_the_format_has_them():
    """floor(sqrt(theta_h / (pi / 2)) 90) and so on, of every bin's centre, is its own index."""
    angles = bin_angles(90, 90, 90)
    np.testing.assert_array_equal(
        np.floor(np.sqrt(angles.theta_h / (np.pi / 2)) * 90).ravel(), np.arange(90)
    )
    np.testing.assert_array_equal(
        np.floor(angles.theta_d / (np.pi / 2) * 90).ravel(), np.arange(90)
    )
    np.testing.assert_array_equal(np.floor(angles.phi_d / np.pi * 180).ravel(), np.arange(90))
    wi, wo = bin_directions()
    assert wi.shape == (90, 90, 180, 3)
    np.testing.assert_allclose(np.linalg.norm(wo, axis=-1), 1.0)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "ends after 0 bytes"),
        (b"\x5a\0\0\0\x5a\0", "ends after 6 bytes"),
        (merl_bytes(np.zeros((3, 1, 1, 1)), (90, 90, 360)), "90 x 90 x 360"),
        (merl_bytes(np.zeros((3, 1, 1, 1)), (2**31 - 1, 2**31 - 1, 2**31 - 1)), "2147483647"),
        (merl_bytes(np.zeros((3, 1, 1, 1)), (-90, 90, 180)), "-90 x 90 x 180"),
        (merl_bytes(np.zeros((3, 1, 1, 1))), "channel R at theta_h bin 0"),
        (merl_bytes(np.zeros((3, 64, 90, 180))), "channel B at theta_h bin 12"),
        (merl_bytes(np.zeros((3, 90, 90, 180))) + b"\0", "something follows"),
    ],
)
def test_hostile_headers_and_truncated_files(data, says):
    with pytest.raises(BrdfError, match=says):
        read_merl(data)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_a_number_that_cannot_be_is_named_with_its_place(bad):
    samples = coloured_samples().copy()
    samples[1, 10, 20, 30] = bad
    with pytest.raises(
        BrdfError, match="channel G at theta_h bin 10, theta_d bin 20, phi_d bin 30"
    ):
        read_merl(merl_bytes(samples))


def test_a_table_without_measurements_is_refused():
    samples = coloured_samples().copy()
    samples[:, 20:] = -1.0
    with pytest.raises(BrdfError, match="above the horizon are negative"):
        read_merl(merl_bytes(samples))


def test_it_is_known_by_its_first_bytes():
    assert is_merl(merl_bytes(np.zeros((3, 1, 1, 1)), (90, 90, 360)))
    for other in (
        b'{"model": "ggx"}',
        b"# num wls\n31",
        b"tensor_file\0\1\0\0\0",
        b"\x89HDF\r\n\x1a\n" + b"\0" * 9,
        b"ab",
    ):
        assert not is_merl(other)
