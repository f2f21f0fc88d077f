import numpy as np

from prtbake_workers.compress.cluster_factors import (
    fit_cluster,
    projected_weights,
    vertex_basis,
)
from prtbake_workers.compress.view_basis import (
    initial_view_basis,
    project_view,
    view_basis_of_grams,
    view_gram_of_cluster,
)


def _updated(transfer, members, bases, factors, n_channels=1):
    """Of three columns, from what the clusters give one by one."""
    grams = [
        view_gram_of_cluster(transfer[m], u, f, np.ones(len(m)), n_channels)
        for m, u, f in zip(members, bases, factors, strict=True)
    ]
    return view_basis_of_grams(grams, 3)


def test_channels_share_the_best_update(coloured):
    """Against the SVD of all channels' cores side by side, from the definition."""
    n_terms, ones = 9, np.ones(len(coloured))
    by_channel = coloured.reshape(3 * len(coloured), n_terms, -1)
    start = initial_view_basis(by_channel, np.ones(len(by_channel)), 3)
    z = np.empty((len(by_channel), 3, by_channel.shape[2]), np.float32)
    project_view(by_channel, start, z)
    z = z.reshape(len(coloured), 9, -1)
    members = [np.arange(0, 200, dtype=np.int32), np.arange(200, 600, dtype=np.int32)]
    factors = [fit_cluster(z[m], ones[m], 8, 6, start=None, sweeps=0)[0] for m in members]
    bases = [
        vertex_basis(projected_weights(z[m], f), ones[m])
        for m, f in zip(members, factors, strict=True)
    ]
    updated = _updated(coloured, members, bases, factors, 3)

    def captured(by_term):
        unfolded = np.concatenate(
            [
                np.einsum(
                    "vr,vckl,ls->krcs", u, by_term[m].astype(float), f.light.astype(float)
                ).reshape(n_terms, -1)
                for m, u, f in zip(members, bases, factors, strict=True)
            ],
            axis=1,
        )
        return np.sum((updated.T @ unfolded) ** 2), np.sum(np.linalg.svd(unfolded)[1][:3] ** 2)

    found, best = captured(coloured.reshape(600, 3, n_terms, -1))
    np.testing.assert_allclose(found, best, rtol=1e-6)
    # negative twin: rows read term by term
    found, best = captured(coloured.reshape(600, n_terms, 3, -1).swapaxes(1, 2))
    assert found < 0.99 * best


def _projected(transfer, basis):
    z = np.empty((len(transfer), basis.shape[1], transfer.shape[2]), np.float32)
    return z, project_view(transfer, basis, z)


def test_initial_basis_is_that_of_the_svd(glossy, rng):
    weights = rng.random(len(glossy))
    basis = initial_view_basis(glossy, weights, 4)
    scaled = glossy * np.sqrt(weights)[:, None, None]
    unfolded = scaled.astype(float).transpose(1, 0, 2).reshape(glossy.shape[1], -1)
    expected = np.linalg.svd(unfolded, full_matrices=False)[0][:, :4]
    # float32 rows over the gaps of this spectrum.
    np.testing.assert_allclose(basis @ basis.T, expected @ expected.T, atol=1e-5)
    unweighted = initial_view_basis(glossy, np.ones(len(glossy)), 4)
    assert not np.allclose(unweighted @ unweighted.T, expected @ expected.T, atol=1e-5)


def test_projection_and_what_it_leaves_out(glossy):
    basis = initial_view_basis(glossy, np.ones(len(glossy)), 4)
    z, left_out = _projected(glossy, basis)
    expected = np.einsum("kr,vkl->vrl", basis.astype(float), glossy.astype(float))
    np.testing.assert_allclose(z, expected, atol=1e-6)
    energy = np.sum(glossy.astype(float) ** 2, axis=(1, 2)) - np.sum(expected**2, axis=(1, 2))
    np.testing.assert_allclose(left_out, energy, atol=1e-6 * energy.max() + 1e-9)
    full = initial_view_basis(glossy, np.ones(len(glossy)), glossy.shape[1])
    _, nothing = _projected(glossy, full)
    assert nothing.sum() < 1e-12 * np.sum(glossy.astype(float) ** 2)


def test_update_is_the_best_for_its_light_and_vertex_bases(glossy):
    ones = np.ones(len(glossy))
    # A poor start, so that the update has something to win.
    start = np.eye(glossy.shape[1], 3, -4, dtype=np.float32)
    z, _ = _projected(glossy, start)
    members = [np.arange(0, 200, dtype=np.int32), np.arange(200, 600, dtype=np.int32)]
    factors = [fit_cluster(z[m], ones[m], 8, 6, start=None, sweeps=0)[0] for m in members]
    bases = [
        vertex_basis(projected_weights(z[m], f), ones[m])
        for m, f in zip(members, factors, strict=True)
    ]
    updated = _updated(glossy, members, bases, factors)

    unfolded = np.concatenate(
        [
            np.einsum("vr,vkl,ls->krs", u, glossy[m].astype(float), f.light.astype(float)).reshape(
                glossy.shape[1], -1
            )
            for m, u, f in zip(members, bases, factors, strict=True)
        ],
        axis=1,
    )
    best = np.sum(np.linalg.svd(unfolded)[1][:3] ** 2)
    np.testing.assert_allclose(np.sum((updated.T @ unfolded) ** 2), best, rtol=1e-6)
    assert np.sum((start.T @ unfolded) ** 2) < 0.5 * best
