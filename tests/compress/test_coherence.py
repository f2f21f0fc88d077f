import numpy as np
import pytest

from prtbake_storage.decode.overdraw import average_overdraw
from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.affine_clusters import AffineClusters
from prtbake_workers.compress.classify import reclassify
from prtbake_workers.compress.cluster_factors import ClusterFactors
from prtbake_workers.compress.coherence import (
    ClusterPlaces,
    Coherence,
    cheapest_clusters,
    coherence_of,
)
from prtbake_workers.compress.cpca import compress_cpca
from prtbake_workers.compress.cta import CtaRanks, compress_cta
from prtbake_workers.compress.lbg import lbg
from support.grid_mesh import grid_faces, grid_positions, sphere_faces
from synthetic_transfer import equal_area_directions

SIDE = 12


def _two_regions(rng, noise=0.35):
    """Signal of a grid whose left half is about 0 and right half about 1 in each of two dims."""
    truth = (np.arange(SIDE * SIDE) % SIDE >= SIDE // 2).astype(float)
    signal = truth[:, None] + noise * rng.standard_normal((SIDE * SIDE, 2))
    return signal.astype(np.float32)


def _labels(signal, coherence, n_clusters=2):
    return lbg(
        signal,
        n_clusters,
        rng=np.random.default_rng(3),
        weights=np.ones(len(signal)),
        max_iterations=30,
        coherence=coherence,
    ).labels


def _by_hand(coherence, labels, distances):
    """E of every vertex and cluster: [Chen2005]_ eqs. (9) and (10), pair by pair."""
    n_verts, n_clusters = distances.shape
    costs = np.empty((n_verts, n_clusters))
    for vert in range(n_verts):
        for cluster in range(n_clusters):
            others = [k for k in range(n_verts) if labels[k] == cluster and k != vert]
            apart = [
                np.linalg.norm(coherence.positions[vert] - coherence.positions[k]) for k in others
            ]
            costs[vert, cluster] = distances[vert, cluster] + coherence.alpha * min([*apart, 1.0])
    return costs


@pytest.mark.parametrize("alpha", [0.05, 2.0])
def test_the_cheapest_cluster_is_that_of_the_equations(rng, alpha):
    coherence = coherence_of(rng.random((60, 3)), alpha)
    assert coherence is not None
    labels = rng.integers(0, 5, 60).astype(np.int32)
    labels[labels == 4] = 3
    labels[7] = 4  # alone in its cluster
    distances = rng.random((60, 6))
    costs = _by_hand(coherence, labels, distances)
    places = ClusterPlaces(coherence, labels, 6)  # the last one is empty
    found = np.concatenate(
        [
            cheapest_clusters(places, part, labels, distances[part])
            for part in (slice(0, 25), slice(25, 60))
        ]
    )
    np.testing.assert_array_equal(found, np.argmin(costs, axis=1))
    assert not np.array_equal(found, np.argmin(distances, axis=1)) or alpha < 1.0


def test_ragged_clusters_become_coherent(rng):
    signal, faces = _two_regions(rng), grid_faces(SIDE)
    positions = grid_positions(SIDE)
    plain = average_overdraw(faces, _labels(signal, None))
    little, much = (
        average_overdraw(faces, _labels(signal, coherence_of(positions, alpha)))
        for alpha in (0.05, 3.0)
    )
    assert much < little <= plain
    assert much - 1.0 < 0.8 * (plain - 1.0)


def test_no_coherence_and_alpha_zero_are_the_same_bytes(diffuse, glossy):
    directions = equal_area_directions(len(diffuse))
    assert coherence_of(directions, 0.0) is None
    assert coherence_of(directions, None) is None
    for compress, data, sizes in (
        (compress_cpca, diffuse, (8, 3)),
        (compress_cta, glossy, (8, CtaRanks(4, 10, 6))),
    ):
        plain, zero, some = (
            compress(
                data, *sizes, seed=2, max_iterations=6, coherence=coherence_of(directions, alpha)
            )
            for alpha in (None, 0.0, 5.0)
        )
        assert plain.weights.tobytes() == zero.weights.tobytes()
        assert plain.labels.tobytes() == zero.labels.tobytes()
        assert plain.labels.tobytes() != some.labels.tobytes()


def test_alpha_means_the_same_at_any_scale(rng):
    signal, positions = _two_regions(rng), grid_positions(SIDE)
    labels = _labels(signal, coherence_of(positions, 0.7))
    # powers of two change no rounding
    scaled = _labels(256.0 * signal, coherence_of(1024.0 * positions, 0.7))
    np.testing.assert_array_equal(labels, scaled)
    assert not np.array_equal(labels, _labels(signal, Coherence(positions, 0.7)))


def test_tensors_of_coherent_clusters_are_drawn_less_often(glossy):
    directions = equal_area_directions(len(glossy))
    faces = sphere_faces(directions)
    plain, coherent = (
        compress_cta(
            glossy, 12, CtaRanks(4, 12, 6), seed=1, coherence=coherence_of(directions, alpha)
        )
        for alpha in (None, 2.0)
    )
    overdraw = [average_overdraw(faces, model.labels) for model in (plain, coherent)]
    assert overdraw[1] < overdraw[0]
    assert np.all(np.diff(coherent.objective) <= 1e-7 * coherent.initial_energy)


@pytest.mark.parametrize("method", ["iterative", "adaptive"])
def test_classification_by_error_keeps_clusters_together(rng, method, monkeypatch):
    """The halves of a grid lie on two lines that cross: near there either serves a vertex."""
    lines = np.linalg.qr(rng.standard_normal((10, 2)))[0].T
    truth = np.arange(SIDE * SIDE) % SIDE >= SIDE // 2
    along = rng.uniform(-1.0, 1.0, (SIDE * SIDE, 1)) * lines[truth.astype(int)]
    noise = 0.1 * rng.standard_normal(along.shape)
    signal, faces = (along + noise + 1.0).astype(np.float32), grid_faces(SIDE)
    options = {
        "seed": 1, "max_iterations": 8, "coherence": coherence_of(grid_positions(SIDE), 3.0),
    }  # fmt: skip
    static, coherent = (
        compress_cpca(signal, 2, 1, method=name, **options) for name in ("static", method)
    )
    assert coherent.objective[-1] < static.objective[-1]
    # the same, but for coherence in the clusters that it starts from alone
    monkeypatch.setattr(AffineClusters, "coherent_moves", lambda *_: None)
    started = compress_cpca(signal, 2, 1, method=method, **options)
    overdraw = [average_overdraw(faces, model.labels) for model in (coherent, started)]
    assert overdraw[0] - 1.0 < 0.95 * (overdraw[1] - 1.0)


def test_a_vertex_moves_only_where_that_pays():
    z = np.array([[[1.0, 0.0]], [[0.9, 0.1]], [[0.0, 1.0]], [[0.1, 0.9]]], np.float32)
    factors = [
        ClusterFactors(np.eye(2, dtype=np.float32), np.eye(2, dtype=np.float32)[i : i + 1])
        for i in range(2)
    ]
    start = np.array([0, 1, 1, 1], np.int32)
    errors = np.array([0.0, 0.81, 0.0, 0.01])
    for pays, moved in ((None, 1), (lambda verts, cluster, residuals: residuals < 0.0, 0)):
        labels, left = start.copy(), errors.copy()
        assert reclassify(z, factors, labels, left, pays) == moved
        assert np.array_equal(labels, start) == (moved == 0)


@pytest.mark.parametrize(
    ("positions", "alpha", "message"),
    [
        (np.zeros((4, 3)), -0.1, "coherence is -0.1"),
        (np.zeros((4, 3)), np.nan, "coherence is nan"),
        (np.zeros((4, 2)), 1.0, "positions"),
        (np.full((4, 3), np.inf), 1.0, "positions"),
    ],
)
def test_what_is_no_place_or_no_price_is_refused(positions, alpha, message):
    with pytest.raises(SettingsError, match=message):
        coherence_of(positions, alpha)


def test_positions_of_another_mesh_are_refused(rng):
    with pytest.raises(SettingsError, match="9 positions for 144 vertices"):
        _labels(_two_regions(rng), coherence_of(grid_positions(3), 1.0))


def test_vertices_in_one_point_have_no_coherence():
    assert coherence_of(np.ones((5, 3)), 1.0) is None
