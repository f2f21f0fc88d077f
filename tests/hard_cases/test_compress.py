"""Signals that leave the compressors little to work with, and signals they must refuse."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress import cta_fit
from prtbake_workers.compress.clusters import refill_empty_clusters
from prtbake_workers.compress.cpca import compress_cpca
from prtbake_workers.compress.cta import CtaRanks, compress_cta

RANKS = CtaRanks(4, 6, 5)
SHAPE = (60, 6, 20)


@pytest.fixture
def transfer(rng):
    """Six smooth families of vertices, with noise that no small basis holds."""
    families = rng.standard_normal((6, 3, *SHAPE[1:]))
    mixing = rng.standard_normal((SHAPE[0], 3))
    family = np.arange(SHAPE[0]) % 6
    smooth = np.einsum("vm,vmkl->vkl", mixing, families[family])
    return (smooth + 0.05 * rng.standard_normal(SHAPE)).astype(np.float32)


def _compress(method, transfer, n_clusters=4, *, ranks=RANKS, **options):
    """Compress by either method and check what must hold for any input."""
    if method == "cta":
        data = transfer
        model = compress_cta(data, n_clusters, ranks, seed=0, **options)
    else:
        data = transfer.reshape(len(transfer), np.prod(transfer.shape[1:]))
        model = compress_cpca(data, n_clusters, ranks.vert, seed=0, **options)
    weights = options.get("vertex_weights")
    weights = np.ones(len(data)) if weights is None else weights
    rebuilt = model.reconstruct()
    difference = (data.astype(float) - rebuilt).reshape(len(data), -1)
    squared = np.sum(difference**2, axis=1)
    scale = max(model.initial_energy, np.finfo(float).tiny)
    assert rebuilt.dtype == np.float32
    assert np.all(np.isfinite(rebuilt))
    assert abs(weights @ squared - model.objective[-1]) <= 1e-6 * scale
    assert np.all(np.diff(model.objective) <= 1e-7 * scale)
    assert sorted(set(model.labels.tolist())) == list(range(model.n_clusters))
    return model


both = pytest.mark.parametrize("method", ["cta", "cpca"])


@both
def test_more_clusters_than_vertices(method, transfer):
    model = _compress(method, transfer[:5], 12)
    assert model.n_clusters <= 5
    assert any("n_clusters 12 cut to 5" in note for note in model.notes)


def test_as_many_clusters_as_vertices_leave_only_what_the_ranks_cut(transfer):
    model = _compress("cta", transfer[:5], 5, ranks=CtaRanks(6, 6, 1))
    assert model.squared_error_ratio < 1e-10
    model = _compress("cpca", transfer[:5], 5)
    assert model.squared_error_ratio < 1e-10


def test_clusters_with_fewer_vertices_than_ranks(transfer):
    model = _compress("cta", transfer, 30, ranks=CtaRanks(6, 20, 40))
    sizes = np.bincount(model.labels)
    assert sizes.min() < 40
    assert np.all(model.ranks[:, 2] <= sizes)
    # Every cluster holds all its vertices exactly, to float32.
    assert model.squared_error_ratio < 1e-10
    model = _compress("cpca", transfer, 30, ranks=CtaRanks(1, 1, 40))
    assert np.all(model.ranks < np.bincount(model.labels))
    assert model.squared_error_ratio < 1e-10


@both
def test_one_vertex(method, transfer):
    model = _compress(method, transfer[:1], 3, ranks=CtaRanks(6, 20, 5))
    assert model.n_clusters == 1
    assert model.squared_error_ratio < 1e-12


@both
def test_one_cluster(method, transfer):
    assert _compress(method, transfer, 1).n_clusters == 1


@both
def test_identical_vertices(method, transfer):
    same = np.repeat(transfer[:1], 50, axis=0)
    model = _compress(method, same, 4, ranks=CtaRanks(6, 20, 5))
    assert model.n_clusters == 1
    assert model.squared_error_ratio < 1e-12
    assert any("3 clusters left out" in note for note in model.notes)


@both
def test_all_zero_transfer(method):
    model = _compress(method, np.zeros(SHAPE, np.float32))
    assert model.n_clusters == 1
    assert model.objective[-1] == 0.0
    assert model.squared_error_ratio == 0.0
    assert not model.weights.any()


@both
def test_some_vertices_all_zero(method, transfer):
    transfer[::3] = 0.0
    model = _compress(method, transfer)
    rebuilt = model.reconstruct().reshape(len(transfer), -1)
    if method == "cta":
        assert not rebuilt[::3].any()


@both
def test_rank_deficient(method, rng):
    factors = rng.standard_normal((60, 2)), rng.standard_normal((2, 3)), rng.standard_normal((3, 6))
    light = rng.standard_normal((2, 20))
    exact = np.einsum("va,ab,bk,al->vkl", *factors, light).astype(np.float32)
    model = _compress(method, exact, 2)
    assert model.squared_error_ratio < 1e-11
    if method == "cta":
        assert np.all(model.ranks[:, 1:] <= 2)
    else:
        assert np.all(model.ranks <= 2)
    noisy = exact + 0.01 * rng.standard_normal(exact.shape).astype(np.float32)
    assert _compress(method, noisy, 2).squared_error_ratio > 1e-6


@both
def test_ranks_beyond_the_dimensions_are_cut_with_a_note(method, transfer):
    model = _compress(method, transfer, 2, ranks=CtaRanks(99, 999, 9999))
    assert model.squared_error_ratio < 1e-11
    notes = "; ".join(model.notes)
    for name in ("ranks.view", "ranks.light", "ranks.vert") if method == "cta" else ("components",):
        assert name in notes


@both
@pytest.mark.parametrize("scale", [1e-8, 1e8])
def test_scale_of_the_signal(method, transfer, scale):
    plain = _compress(method, transfer)
    scaled = _compress(method, (transfer * np.float32(scale)).astype(np.float32))
    # Rounding the scaled signal may move single vertices between nearly equal clusters.
    assert scaled.squared_error_ratio == pytest.approx(plain.squared_error_ratio, rel=0.05)


@both
@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_scale_beyond_float32_squares_is_refused(method, transfer, scale):
    with pytest.raises(SettingsError, match="scale it"):
        _compress(method, transfer * np.float32(scale))


@both
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused_with_its_vertex(method, transfer, value):
    transfer[37, 4, 11] = value
    with pytest.raises(SettingsError, match=r"at vertex 37 \(") as caught:
        _compress(method, transfer)
    where = "terms 4, coeffs 11" if method == "cta" else f"dims {4 * SHAPE[2] + 11}"
    assert where in caught.value.detail


@both
def test_float64_is_refused(method, transfer):
    with pytest.raises(SettingsError, match="must be float32, not float64"):
        _compress(method, transfer.astype(np.float64))


@both
@pytest.mark.parametrize("shape", [(0, 6, 20), (5, 0, 20), (5, 6, 0)])
def test_an_empty_axis_is_refused(method, shape):
    with pytest.raises(SettingsError, match="has no"):
        _compress(method, np.zeros(shape, np.float32))


@both
def test_settings_below_one_are_refused_by_name(method, transfer):
    with pytest.raises(SettingsError, match="n_clusters") as caught:
        _compress(method, transfer, 0)
    assert caught.value.pointer == "/n_clusters"
    with pytest.raises(SettingsError, match=r"ranks/vert|n_components"):
        _compress(method, transfer, ranks=CtaRanks(4, 6, 0))
    with pytest.raises(SettingsError, match="max_iterations"):
        _compress(method, transfer, max_iterations=0)


@both
def test_vertices_without_weight_do_not_pull_but_are_served(method, transfer, rng):
    weights = np.ones(len(transfer))
    weights[::4] = 0.0
    counted = weights > 0.0
    weighted = _compress(method, transfer, 1, vertex_weights=weights)
    without = _compress(method, transfer[counted], 1)
    plain = _compress(method, transfer, 1).squared_error_per_vertex[counted].sum()
    assert weighted.objective[-1] == pytest.approx(without.objective[-1], rel=1e-4)
    assert weighted.objective[-1] != pytest.approx(plain, rel=1e-4)

    weighted = _compress(method, transfer, 6, vertex_weights=weights)
    # They follow the same families, so the others' bases hold them: far better than nothing.
    energy = np.sum(transfer.astype(float) ** 2, axis=(1, 2))
    assert weighted.squared_error_per_vertex[~counted].sum() < 0.8 * energy[~counted].sum()


@both
def test_a_single_vertex_with_weight(method, transfer):
    weights = np.zeros(len(transfer))
    weights[7] = 3.0
    model = _compress(method, transfer, 4, ranks=CtaRanks(6, 6, 5), vertex_weights=weights)
    assert model.objective[-1] <= 1e-10 * model.initial_energy


@both
@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ([-1.0], "at vertex 59"),
        ([np.nan], "at vertex 59"),
        ([0.0], "all zero"),
        ([1.0, 1.0], "shape"),
    ],
)
def test_weights_that_are_refused(method, transfer, weights, message):
    weights = np.concatenate([np.zeros(59), weights])
    with pytest.raises(SettingsError, match=message) as caught:
        _compress(method, transfer, vertex_weights=weights)
    assert caught.value.pointer == "/vertex_weights"


@pytest.mark.parametrize("seed", [0, 3, 5])
def test_clusters_that_run_empty_are_filled_again(seed, monkeypatch):
    # Vertices that differ by a factor start in different clusters and then share one.
    rng = np.random.default_rng(seed)
    families = rng.standard_normal((5, 6, 20))[np.arange(80) % 5]
    factor = 3.0 * rng.standard_normal((80, 1, 1))
    noise = 0.02 * rng.standard_normal(families.shape)
    filled = []

    def watched(*arguments):
        found = refill_empty_clusters(*arguments)
        filled.extend(found)
        return found

    monkeypatch.setattr(cta_fit, "refill_empty_clusters", watched)
    model = _compress(
        "cta", (families * factor + noise).astype(np.float32), 16, ranks=CtaRanks(4, 6, 1)
    )
    assert filled
    assert model.n_clusters == 16


@both
def test_input_that_is_not_contiguous(method, transfer):
    mirrored = np.asfortranarray(transfer)
    assert _compress(method, mirrored).objective == _compress(method, transfer).objective


@both
def test_input_is_not_written_to(method, transfer):
    before = transfer.tobytes()
    transfer.flags.writeable = False
    _compress(method, transfer, 8)
    assert transfer.tobytes() == before
