"""Both kinds of basis through a file."""

import h5py
import numpy as np
import pytest

from prtbake_storage.decode.transfer_basis import SphericalHarmonics, WhitenedSrbfs
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5 import primitives as h5
from prtbake_storage.hdf5.basis import get_basis, put_basis

SRBFS = WhitenedSrbfs(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]), 7.5)


def written(path, basis):
    with h5.new_file(path, "asset") as file:
        put_basis(file, basis)
    return path


def read(path):
    with h5.open_file(path, "asset") as file:
        return get_basis(file)


def test_spherical_harmonics_come_back(tmp_path):
    found = read(written(tmp_path / "a.h5", SphericalHarmonics(7)))
    assert found == SphericalHarmonics(7)
    assert (found.kind, found.n_coeffs) == ("sh", 49)


def test_srbfs_carry_no_kind_and_a_file_without_one_is_read_as_srbfs(tmp_path):
    path = written(tmp_path / "a.h5", SRBFS)
    with h5py.File(path) as file:
        assert "kind" not in file["basis"].attrs
    found = read(path)
    assert isinstance(found, WhitenedSrbfs)
    np.testing.assert_array_equal(found.centres, SRBFS.centres)
    assert (found.kind, found.bandwidth, found.n_coeffs) == ("srbf", 7.5, 2)


@pytest.mark.parametrize(
    ("attributes", "named"),
    [
        ({"kind": "wavelet"}, "kind is 'wavelet'"),
        ({"order": 0}, "order is 0"),
        ({"order": 101}, "order is 101"),
        ({"order": 2.5}, "order is 2.5"),
    ],
)
def test_numbers_out_of_range_are_named(tmp_path, attributes, named):
    path = written(tmp_path / "a.h5", SphericalHarmonics(7))
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        for name, value in attributes.items():
            del file["basis"].attrs[name]
            h5.set_attribute(file["basis"], name, value)
    with pytest.raises(CorruptArtefact, match=named):
        read(path)


@pytest.mark.parametrize(
    ("basis", "named"),
    [
        (SphericalHarmonics(0), "basis/order is 0"),
        (WhitenedSrbfs(SRBFS.centres[:, :2], 7.5), "basis/centres has shape"),
        (WhitenedSrbfs(SRBFS.centres.astype(np.float32), 7.5), "basis/centres is float32"),
        (WhitenedSrbfs(SRBFS.centres * np.nan, 7.5), "basis/centres is not finite at"),
        (WhitenedSrbfs(SRBFS.centres, 0.0), "basis/bandwidth is 0.0"),
    ],
)
def test_a_basis_names_the_field_that_breaks_its_rules(basis, named):
    SRBFS.check()
    with pytest.raises(ValueError, match=named):
        basis.check()
