"""Bytes of a number by a trial, against factors that were rounded and written to a file."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_workers.basis.sh_basis import ShBasis
from prtbake_workers.compress.methods import Fit, compress
from prtbake_workers.planning.cost import factor_floats
from prtbake_workers.planning.file_bytes import FACTOR_BYTES
from prtbake_workers.planning.packed_factors import WholePart, factor_bytes
from prtbake_workers.planning.presets import PartCompression
from support.part_file import factor_bytes_in_file

N_VERTS, N_TERMS, N_COEFFS, SHARE = 1600, 4, 49, 0.01
CPCA = PartCompression("cpca", 4, (1, 1, 1), 6)
CTA = PartCompression("cta", 4, (3, 16, 8), 6)


def transfer(noise):
    """Four clusters, each about a mean of its own in few dimensions, and noise over all of them."""
    rng = np.random.default_rng(3)
    dims = N_TERMS * N_COEFFS
    fall = np.exp(-0.7 * np.arange(1, 11))
    rows = [
        4.0 * rng.standard_normal(dims)
        + (rng.standard_normal((N_VERTS // 4, 10)) * fall) @ rng.standard_normal((10, dims))
        for _ in range(4)
    ]
    found = np.concatenate(rows) + noise * rng.standard_normal((N_VERTS, dims))
    return found.reshape(N_VERTS, N_TERMS, N_COEFFS).astype(np.float32)


def whole_part(compression, phi=None):
    size = {"n_verts": N_VERTS, "n_terms": N_TERMS, "n_coeffs": N_COEFFS}
    return WholePart(N_VERTS, compression, factor_floats(compression, **size), phi)


def measured(coefficients, compression, path):
    """Bytes of a number as a job has them: found by its own search, taken from its file."""
    areas = np.full(N_VERTS, 1.0 / N_VERTS)
    fit = Fit(seed=0, max_iterations=6, vertex_weights=areas)
    done = compress(compression.method, coefficients, compression, fit)
    return factor_bytes_in_file(done, areas, SHARE, ShBasis(7).stored, path)


@pytest.mark.parametrize("compression", [CPCA, CTA], ids=["cpca", "cta"])
@pytest.mark.parametrize("noise", [0.3, 1e-4])
def test_a_quarter_of_the_vertices_tells_the_bytes_of_all(compression, noise, tmp_path):
    coefficients = transfer(noise)
    expected = measured(coefficients, compression, tmp_path / "file.h5")
    some = slice(None, None, 4)
    found = factor_bytes(
        coefficients[some], np.ones(N_VERTS // 4), 4, whole_part(compression), share=SHARE
    )
    # a quarter fits its noise better than the whole does, and little arrays pack worse: by less
    # than half a bit, of the 2.4 that the coarsest have
    assert found.factors == pytest.approx(expected, rel=0.15)
    assert found.texture == 0.0


def test_what_is_left_decides_the_bits():
    """Negative twin: no constant is near both."""
    areas = np.ones(N_VERTS)
    found = [
        factor_bytes(transfer(noise), areas, 4, whole_part(CPCA), share=SHARE).factors
        for noise in (0.3, 1e-4)
    ]
    assert found[1] > 1.3 * found[0]
    assert not all(0.85 < one / FACTOR_BYTES["auto"] < 1.15 for one in found)


def test_an_error_that_is_given_counts_in_place_of_the_share():
    areas, coefficients = np.ones(N_VERTS), transfer(0.3)
    coarse, fine = (
        factor_bytes(coefficients, areas, 4, whole_part(CPCA), share=SHARE, max_error=error).factors
        for error in (1e-3, 1e-6)
    )
    # a thousandth of the error is five bits more
    assert fine - coarse == pytest.approx(5.0 / 8.0, rel=0.25)


def test_textures_are_rounded_with_the_factors():
    rng = np.random.default_rng(1)
    phi = rng.standard_normal((32, 32, N_TERMS, 1)).astype(np.float32)
    areas, coefficients = np.ones(N_VERTS), transfer(0.3)
    own = whole_part(CTA, phi)
    found = factor_bytes(coefficients, areas, 4, own, share=SHARE)
    assert 0.3 < found.texture < 2.0
    # of a part with more clusters the same texels carry more, next to each of their numbers
    larger = replace(own, n_verts=8 * N_VERTS, compression=replace(CTA, n_clusters=32))
    larger = replace(larger, factor_floats=8 * own.factor_floats)
    more = factor_bytes(coefficients, areas, 4, larger, share=SHARE)
    assert more.texture > found.texture + 0.1


@pytest.mark.parametrize("compression", [CPCA, CTA], ids=["cpca", "cta"])
def test_dark_parts_pack_to_next_to_nothing(compression, tmp_path):
    dark = np.zeros((N_VERTS, N_TERMS, N_COEFFS), np.float32)
    whole = whole_part(compression)
    expected = measured(dark, compression, tmp_path / "file.h5")
    found = factor_bytes(dark[:50], np.ones(50), 4, whole, share=SHARE)
    # of some hundred bytes each: what gzip begins with
    assert abs(found.factors - expected) * whole.factor_floats < 300
    assert found.factors < 0.02
    # no area says nothing of what there is
    assert factor_bytes(dark[:50] + 1.0, np.zeros(50), 4, whole, share=SHARE) is None


def test_the_texture_of_a_dark_part_has_eight_bits():
    rng = np.random.default_rng(1)
    phi = rng.standard_normal((32, 32, N_TERMS, 1)).astype(np.float32)
    dark = np.zeros((50, N_TERMS, N_COEFFS), np.float32)
    found = factor_bytes(dark, np.ones(50), 4, whole_part(CTA, phi), share=SHARE)
    # normal numbers of which the largest of a thousand is 127 have an entropy of 7.2 bits
    assert found.texture == pytest.approx(7.2 / 8.0, rel=0.1)
