"""Predicted bytes of files against files."""

import h5py
import numpy as np
import pytest

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.decode.light import LightFit
from prtbake_storage.hdf5 import primitives as h5
from prtbake_storage.hdf5.light import write_light
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.brdf.phong import Phong
from prtbake_workers.brdf.view_texture import fit_view_texture
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.teapot import teapot
from prtbake_workers.planning.file_bytes import (
    FACTOR_BYTES,
    KnownBytes,
    NumberBytes,
    PartNumbers,
    asked_asset_bytes,
    asset_bytes,
    known_bytes,
    light_bytes,
    texture_side,
    transfer_bytes,
)
from prtbake_workers.planning.packed_bytes import packed_bytes

MESH = teapot(8)
HALF = np.array([0.5])
COOK = CookTorrance(kd=HALF, ks=HALF, m=0.5, f0=np.array([0.1]))
MIDDLE = Phong(np.array([0.3]), np.array([0.6]), 20.0)
SHARP = Phong(np.array([0.0]), HALF, 200.0)


def stored_bytes(path, array):
    """What a file takes for an array, without its header."""
    with h5.new_file(path, "asset") as file:
        h5.put(file, "array", array, " ".join(f"axis{i}" for i in range(array.ndim)))
    with h5py.File(path) as file:
        return file["array"].id.get_storage_size()


@pytest.mark.parametrize(
    "array",
    [
        MESH.positions,
        MESH.positions.astype(np.float32),
        MESH.faces,
        np.random.default_rng(0).standard_normal((40_000, 12)).astype(np.float32),
        np.zeros((100, 3)),
        np.arange(7, dtype=np.int16),
    ],
)
def test_arrays_pack_as_files_pack_them(array, tmp_path):
    # of large ones some chunks stand for all
    assert packed_bytes(array) == pytest.approx(stored_bytes(tmp_path / "file.h5", array), rel=0.01)
    # negative twin: noise packs to no such size
    noise = np.random.default_rng(1).bytes(array.nbytes)
    if array.nbytes > 1000 and array.shape != (40_000, 12):
        other = np.frombuffer(noise, array.dtype).reshape(array.shape)
        assert packed_bytes(other) > 1.2 * packed_bytes(array)


def test_nothing_takes_no_bytes():
    assert packed_bytes(np.zeros((0, 3))) == 0


@pytest.mark.parametrize(
    ("brdf", "n_terms"),
    [(COOK, 8), (MIDDLE, 4), (SHARP, 15)],
)
def test_the_view_texture_s_resolution_is_foreseen(brdf, n_terms):
    factorisation = factorise(brdf, n_terms=n_terms)
    assert texture_side(factorisation) == fit_view_texture(factorisation).resolution


def known_of(n_terms):
    brdf = Lambert(HALF) if n_terms == 1 else COOK
    factorisation = factorise(brdf, n_terms=n_terms)
    frames = np.tile(np.eye(3), (MESH.n_vertices, 1, 1))
    return known_bytes([MESH.positions, MESH.normals], MESH.faces, [[]], [factorisation], [frames])


def test_more_of_anything_is_more_bytes():
    known = known_of(8)
    part = PartNumbers(2000, 8, 1, False, 162, 50_000, 4)
    base = transfer_bytes(known, [part]), asset_bytes(known, [part], bits=16)
    for field, value, grows in (
        ("n_verts", 3000, (True, True)),  # their labels
        ("n_rows", 9, (True, False)),
        ("n_coeffs", 642, (True, False)),
        ("factor_floats", 60_000, (False, True)),
        ("view_columns", 8, (False, True)),
    ):
        more = PartNumbers(**{**part.__dict__, field: value})
        found = transfer_bytes(known, [more]), asset_bytes(known, [more], bits=16)
        assert tuple(b > a for a, b in zip(base, found, strict=True)) == grows, field
    # what differs less packs better
    for field, value in (("even", True), ("n_channels", 3)):
        one = PartNumbers(**{**part.__dict__, "n_rows": 3, "n_channels": 3, field: value})
        two = PartNumbers(**{**one.__dict__, "even": False, "n_channels": 1, "n_rows": 3})
        assert transfer_bytes(known, [one]) < transfer_bytes(known, [two])
    # of three channels of scattered light none is like another
    three = PartNumbers(**{**part.__dict__, "n_rows": 3, "n_channels": 3})
    own = PartNumbers(**{**three.__dict__, "scattered": True})
    assert transfer_bytes(known, [own]) > 1.2 * transfer_bytes(known, [three])
    lit = PartNumbers(**{**part.__dict__, "n_rows": 1, "even": True})
    moved = PartNumbers(**{**lit.__dict__, "scattered": True})
    assert asset_bytes(known, [moved], bits="auto") > asset_bytes(known, [lit], bits="auto")
    # evenness shows in factors of one term alone
    for rows, less in ((1, True), (8, False)):
        even, plain = (
            asset_bytes(
                known,
                [PartNumbers(**{**part.__dict__, "n_rows": rows, "even": flag})],
                bits="auto",
            )
            for flag in (True, False)
        )
        assert (even < plain) == less
    assert asset_bytes(known, [part], bits=32) > 1.4 * asset_bytes(known, [part], bits=16)
    # a diffuse part has neither frames nor a texture
    plain = known_of(1)
    assert plain.texels == (0,)
    assert plain.transfer < known.transfer
    assert all(plain.asset[bits] < known.asset[bits] for bits in (16, 32))


def test_factors_count_by_their_bits():
    nothing = KnownBytes(0, {16: 0, 32: 0}, (0,))
    few, many = (PartNumbers(100, 1, 1, False, 42, count, 1) for count in (10_000, 30_000))
    for bits in (8, 16, 32, "auto"):
        more = asset_bytes(nothing, [many], bits=bits) - asset_bytes(nothing, [few], bits=bits)
        assert more == pytest.approx(FACTOR_BYTES[bits] * 20_000, abs=1.0)


def test_what_a_trial_found_counts_where_error_chooses_the_bits():
    known = KnownBytes(0, {16: 0, 32: 0}, (64,))
    plain = PartNumbers(100, 1, 1, True, 42, 10_000, 3)
    tried = PartNumbers(**plain.__dict__ | {"tried": NumberBytes(1.6, 0.2)})
    none = PartNumbers(**plain.__dict__ | {"tried": NumberBytes(0.0, 0.0)})
    found = asset_bytes(known, [tried], bits="auto") - asset_bytes(known, [none], bits="auto")
    assert found == pytest.approx(1.6 * 10_000 + 0.2 * 64 * 3, abs=1.0)
    # bits that are asked for are what they are
    for bits in (8, 16, 32):
        assert asset_bytes(known, [tried], bits=bits) == asset_bytes(known, [plain], bits=bits)


@pytest.mark.parametrize("subdivisions", [2, 3])
def test_centres_of_the_basis_are_counted(subdivisions, tmp_path):
    centres = icosphere(subdivisions)
    brdf = factorise(Lambert(HALF))
    without, counted = (
        known_bytes([MESH.positions], MESH.faces, [[]], [brdf], [np.eye(3)[None]], n_centres=count)
        for count in (0, len(centres))
    )
    stored = stored_bytes(tmp_path / "file.h5", centres)
    assert counted.transfer - without.transfer == pytest.approx(stored, rel=0.05)
    assert counted.asset[16] - without.asset[16] == pytest.approx(stored, rel=0.05)


def test_bytes_that_are_asked_for_are_predicted():
    known, part = known_of(8), PartNumbers(2000, 8, 1, False, 162, 50_000, 4)
    free = asset_bytes(known, [part], bits="auto")
    all_numbers = transfer_bytes(known, [part])
    assert asked_asset_bytes(known, [part], CompressSettings()) == free
    for asked, expected in ((free // 2, free // 2), (2 * free, 2 * free), (10**12, all_numbers)):
        settings = CompressSettings(max_bytes=asked)
        assert asked_asset_bytes(known, [part], settings) == expected
    # beside an error they are a limit and nothing to be filled
    for asked, expected in ((free // 2, free // 2), (2 * free, free)):
        settings = CompressSettings(max_bytes=asked, max_error=0.1)
        assert asked_asset_bytes(known, [part], settings) == expected


def test_bytes_that_a_light_may_take_are_predicted():
    assert light_bytes(FitLightSettings(max_bytes=5000)) == 5000
    free = light_bytes(FitLightSettings(n_lobes=24))
    assert light_bytes(FitLightSettings(n_lobes=24, max_bytes=10**6)) == free < 5000


@pytest.mark.parametrize("n_lobes", [12, 160, 400])
def test_the_light_s_file_is_foreseen(n_lobes, rng, tmp_path):
    centres = rng.standard_normal((n_lobes, 3))
    light = LightFit(
        centres=centres / np.linalg.norm(centres, axis=1, keepdims=True),
        bandwidths=rng.uniform(1.0, 90.0, n_lobes),
        coefficients=rng.standard_normal((n_lobes, 3)),
        error=0.01,
        provenance={"environment": "sha256:" + "0" * 64, "settings": {"n_lobes": n_lobes}},
    )
    write_light(tmp_path / "light.h5", light)
    predicted = light_bytes(FitLightSettings(n_lobes=n_lobes))
    assert predicted == pytest.approx((tmp_path / "light.h5").stat().st_size, rel=0.1)
