"""Every method by one interface: the factors that it names are the model."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from prtbake_storage.decode.asset import FACTORS, Part
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.decode.relight import cluster_matrices, vertex_radiance
from prtbake_storage.hdf5.bundle import write_bundle
from prtbake_workers.compress.methods import METHODS, Fit, Model, compress


class Sizes(NamedTuple):
    n_clusters: int = 6
    ranks: tuple[int, int, int] = (5, 30, 12)
    n_components: int = 4


KINDS = {"diffuse": 1, "separable": 1, "coloured": 3}


def coefficients_of(kind, glossy, coloured):
    return {"diffuse": glossy[:, :1], "separable": glossy, "coloured": coloured}[kind]


def part_of(method, compressed, n_verts, n_channels):
    return Part(
        name="object", vertex_range=(0, n_verts), material={}, albedo=np.ones(1, np.float32),
        method=method, n_channels=n_channels, **compressed.factors,
    )  # fmt: skip


def test_the_names_are_those_that_assets_know():
    assert list(METHODS) == list(FACTORS)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", KINDS)
def test_decoding_the_factors_gives_what_the_model_does(method, kind, glossy, coloured, rng):
    rows, n_channels = coefficients_of(kind, glossy, coloured), KINDS[kind]
    weights = rng.uniform(0.5, 2.0, len(rows))
    seen = []
    fit = Fit(
        seed=1, max_iterations=3, n_channels=n_channels, vertex_weights=weights,
        progress=lambda done, _: seen.append(done),
    )  # fmt: skip
    compressed = compress(method, rows, Sizes(), fit)
    model = compressed.model
    assert isinstance(model, Model)
    assert seen[-1] == 1.0
    part = part_of(method, compressed, len(rows), n_channels)
    assert {name for name, _ in part.factors()} >= set(FACTORS[method])
    found = reconstruct(part, slice(None))
    assert found.shape == rows.shape
    np.testing.assert_array_equal(found, model.reconstruct().reshape(rows.shape))
    error = weights @ np.sum((found.astype(float) - rows) ** 2, axis=(1, 2))
    assert error == pytest.approx(model.objective[-1], rel=1e-4)
    assert 0.0 < model.squared_error_ratio < 0.5
    # channel c of the light meets channel c of the reconstruction, term by term
    light = rng.standard_normal((rows.shape[2], 3))
    by_channel = found.reshape(len(rows), n_channels, -1, rows.shape[2]).astype(float)
    by_channel = np.broadcast_to(by_channel, (len(rows), 3, *by_channel.shape[2:]))
    expected = np.einsum("vckl,lc->vkc", by_channel, light)
    lit = vertex_radiance(part, cluster_matrices(part, light))
    relit = np.einsum("kr,vrc->vkc", part.view_basis, lit)
    # float32 sums; 1e-5 of the largest
    atol = 1e-5 * np.abs(expected).max()
    np.testing.assert_allclose(relit, expected, rtol=0, atol=atol)
    wrong = np.einsum("vckl,lc->vkc", by_channel, light[:, [1, 2, 0]])
    assert np.abs(relit - wrong).max() > 1e3 * atol


@pytest.mark.parametrize("method", ["vq", "pca", "cpca"])
def test_a_signal_s_errors_count_all_terms_and_channels_alike(method, coloured):
    """Turning the terms of each channel by a rotation is turning the signal: nothing changes."""
    rng = np.random.default_rng(2)
    turn = np.linalg.qr(rng.standard_normal((9, 9)))[0].astype(np.float32)
    turned = (turn @ coloured.reshape(600, 3, 9, 81)).reshape(coloured.shape)
    fit = Fit(seed=1, max_iterations=3, n_channels=3)
    ratios = [
        compress(method, rows, Sizes(), fit).model.squared_error_ratio
        for rows in (coloured, turned)
    ]
    # the same distances but for rounding; a flip of one vertex would cost 1e-3
    assert ratios[1] == pytest.approx(ratios[0], rel=1e-2)
    stretched = turned.copy()
    stretched[:, 1::9] *= 10.0
    assert compress(method, stretched, Sizes(), fit).model.squared_error_ratio != pytest.approx(
        ratios[0], rel=1e-2
    )


def test_methods_rank_as_published(glossy):
    """[Sloan2003] figure 10: at one speed of pictures clustered PCA errs less than VQ and PCA.

    Its 256 clusters of 8 components have there as many vectors as VQ has means, and PCA 2.5 times
    the components.
    """
    fit = Fit(seed=0, max_iterations=10)
    cpca = compress("cpca", glossy, Sizes(n_clusters=12, n_components=4), fit).model
    vq = compress("vq", glossy, Sizes(n_clusters=12 * 5 + 4), fit).model
    pca = compress("pca", glossy, Sizes(n_components=10), fit).model
    assert vq.nbytes == pytest.approx(cpca.nbytes, rel=0.02)
    assert 2.0 * cpca.squared_error_ratio < min(vq.squared_error_ratio, pca.squared_error_ratio)


@pytest.mark.parametrize("kind", ["separable", "coloured"])
def test_tensors_of_own_ranks_decode_and_fill_no_more_of_a_file(kind, glossy, coloured, tmp_path):
    rows, n_channels = coefficients_of(kind, glossy, coloured), KINDS[kind]
    seen = []
    fit = Fit(
        seed=1, max_iterations=3, n_channels=n_channels, classification="adaptive",
        progress=lambda done, _: seen.append(done),
    )  # fmt: skip
    own = compress("cta", rows, Sizes(), fit)
    even = compress("cta", rows, Sizes(), replace(fit, classification="static"))
    assert sorted(seen[: seen.index(1.0) + 1]) == seen[: seen.index(1.0) + 1]
    assert own.model.squared_error_ratio < even.model.squared_error_ratio
    assert own.model.nbytes <= even.model.nbytes
    found = reconstruct(part_of("cta", own, len(rows), n_channels), slice(None))
    np.testing.assert_array_equal(found, own.model.reconstruct())
    # what only pads the arrays is zeros, which a file packs: 16 bits a number of the model remain
    levels = {
        name: np.rint(array * (32767.0 / np.abs(array).max())).astype(np.int16)
        for name, array in own.factors.items()
        if array.dtype == np.float32
    }
    stored = write_bundle(tmp_path / "own.h5", levels, {}).stat().st_size
    assert stored < 1.06 * own.model.nbytes / 2
    assert sum(array.nbytes for array in levels.values()) > 1.1 * own.model.nbytes / 2
