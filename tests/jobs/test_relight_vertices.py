"""Reading some vertices of a transfer file, against reading all of them."""

import tracemalloc

import numpy as np
import pytest

from prtbake_storage.decode.transfer_basis import WhitenedSrbfs
from prtbake_storage.hdf5.schema import transfer_chunk_vertices
from prtbake_storage.hdf5.transfer import (
    TransferHeader,
    TransferPart,
    join_transfer,
    write_transfer_tile,
)
from prtbake_workers.jobs.validate import READ_CHUNKS, light_rows, relight_vertices

TERMS, COEFFS = 16, 642
STEP = READ_CHUNKS * transfer_chunk_vertices(TERMS, COEFFS)
VERTS = 8 * STEP


@pytest.fixture(scope="module")
def transfer(tmp_path_factory):
    """A file whose vertex v holds v times one random block, and that block."""
    folder = tmp_path_factory.mktemp("transfer")
    rng = np.random.default_rng(0)
    pattern = rng.integers(-1000, 1000, (TERMS, COEFFS)).astype(np.int16)
    scale = np.repeat(np.arange(VERTS, dtype=np.float32)[:, None], TERMS, axis=1)
    energy = np.ones(VERTS)
    write_transfer_tile(
        folder / "tile.h5",
        np.repeat(pattern[None], VERTS, axis=0),
        scale=scale,
        signal_energy=energy,
        residual_energy=energy,
    )
    part = TransferPart(
        name="object", vertex_range=(0, VERTS), material={"model": "lambert"}, areas=energy,
        n_terms=TERMS, albedo=np.ones(1, np.float32), frames=None,
        factorisation={"psi": np.ones((2, 2))},
    )  # fmt: skip
    up = np.tile([0.0, 0.0, 1.0], (VERTS, 1))
    header = TransferHeader(
        positions=rng.normal(size=(VERTS, 3)), faces=np.array([[0, 1, 2]], np.int32), normals=up,
        uv=None, basis=WhitenedSrbfs(up[:COEFFS], 60.0), parts=(part,), provenance={},
    )  # fmt: skip
    join_transfer(folder / "transfer.h5", header, [[folder / "tile.h5"]])
    return folder / "transfer.h5", pattern.astype(np.float64)


@pytest.mark.parametrize(
    "vertices",
    [
        [0, VERTS - 1],
        [3, STEP - 1, STEP, 5 * STEP + 7, 5 * STEP + 9],
        list(range(STEP - 2, 3 * STEP, 5)),
        [],
    ],
)
def test_chosen_vertices_are_lit_as_their_coefficients_say(transfer, rng, vertices):
    path, pattern = transfer
    light = rng.standard_normal((COEFFS, 6))
    chosen = np.array(vertices, np.int64)
    got = relight_vertices(path, 0, chosen, light)
    # float32 coefficients: whole numbers below 2^24 times a whole scale below 2^11
    np.testing.assert_allclose(got, chosen[:, None, None] * (pattern @ light), rtol=1e-5, atol=1e-2)


def test_what_lies_between_the_vertices_is_not_read(transfer, rng):
    path, _ = transfer
    light = rng.standard_normal((COEFFS, 6))
    tracemalloc.start()
    relight_vertices(path, 0, np.array([0, VERTS - 1]), light)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # one chunk of the file and its float32 copy take 3 MiB; the whole file takes 250 MiB so
    assert peak < 2**23


def test_each_colour_is_lit_by_its_own_channel(rng):
    rows = rng.standard_normal((3 * TERMS, 20))
    light = rng.standard_normal((20, 6))
    got = light_rows(rows, light, 3)
    for column in range(6):
        for term in range(TERMS):
            expected = rows[(column % 3) * TERMS + term] @ light[:, column]
            assert got[term, column] == pytest.approx(expected, rel=1e-12, abs=1e-12)
    # one channel lights all colours, which is what three equal ones do
    same = np.tile(rows[:TERMS], (3, 1))
    np.testing.assert_allclose(
        light_rows(same, light, 3), light_rows(rows[:TERMS], light, 1), rtol=1e-12, atol=1e-12
    )
