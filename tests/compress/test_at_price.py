"""Columns and bits at one price: what stays pays, what is left out would not."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.decode.quantise import SHARED_AXES
from prtbake_workers.compress.at_price import NUMBER_PRICE, at_distortion
from prtbake_workers.compress.bit_allocation import measured
from support.rounded_parts import dense, make_part

KINDS = [("cta", 1), ("cta", 3), ("cpca", 1)]


def entropy_bits(part, scales):
    """Bits of all levels, each column of each cluster coded by its own entropy."""
    bits = 0.0
    for name, scale in scales.items():
        array = getattr(part, name).astype(np.float64)
        if name == "weights":
            for cluster, steps in enumerate(scale):
                own = array[part.labels == cluster]
                bits += sum(entropy(own[:, c], steps[c]) for c in range(own.shape[1]))
            continue
        columns = np.moveaxis(array, SHARED_AXES[name], range(len(SHARED_AXES[name])))
        flat = columns.reshape(-1, scale.size)
        bits += sum(entropy(flat[:, c], s) for c, s in enumerate(scale.ravel()))
    return bits


def entropy(values, step):
    if step == 0.0:
        return 0.0
    _, counts = np.unique(np.rint(values / step), return_counts=True)
    return float(-(counts * np.log2(counts / counts.sum())).sum())


def error_of(part, exact, scales, areas):
    """Squared error, columns and rounding together: independent of how either was chosen."""
    off = dense(part) - dense(exact)
    return float(areas @ (off**2).sum(axis=(1, 2, 3))) + measured(part, scales, areas).total


@pytest.fixture
def areas(rng):
    return rng.uniform(0.1, 3.0, 300)


@pytest.mark.parametrize(("method", "channels"), KINDS)
def test_a_larger_distortion_leaves_more_and_takes_less(rng, areas, method, channels):
    part = make_part(rng, method, n_verts=300, n_channels=channels)
    part = with_ranks(part)
    errors, bits = [], []
    for distortion in (1e-7, 1e-5, 1e-3, 1e-1, 10.0):
        left, scales = at_distortion(part, areas, distortion)
        errors.append(error_of(left, part, scales, areas))
        bits.append(entropy_bits(left, scales))
    assert errors == sorted(errors)
    assert bits == sorted(bits, reverse=True)
    assert errors[0] < 1e-3 * errors[-1]


@pytest.mark.parametrize(("method", "channels"), KINDS)
@pytest.mark.parametrize("distortion", [1e-3, 1e-1, 1.0])
def test_no_other_choice_of_columns_is_cheaper(rng, areas, method, channels, distortion):
    """At the price of a bit: keeping all columns costs more, and so does leaving out half of them.

    But for 2 %: entropies are measured, the choice foresees those of Gaussian columns.
    """
    part = with_ranks(make_part(rng, method, n_verts=300, n_channels=channels))

    def cost(left, scales):
        bits = NUMBER_PRICE * distortion * entropy_bits(left, scales)
        return error_of(left, part, scales, areas) + bits

    left, scales = at_distortion(part, areas, distortion)
    found = cost(left, scales)
    # the scales of a far finer price, at which nothing is left out, made as coarse as these
    everything, fine = at_distortion(part, areas, 1e-9 * distortion)
    coarse = {name: (scale * 10**4.5).astype(np.float32) for name, scale in fine.items()}
    assert found <= 1.02 * cost(everything, coarse)


@pytest.mark.parametrize(("method", "channels"), KINDS)
def test_what_stays_pays(rng, areas, method, channels):
    """Without the last column of each cluster that stays, the rest costs more than with it."""
    part = with_ranks(make_part(rng, method, n_verts=300, n_channels=channels))
    price = NUMBER_PRICE * 1e-3
    left, scales = at_distortion(part, areas, 1e-3)
    found = error_of(left, part, scales, areas) + price * entropy_bits(left, scales)
    last = left.ranks[left.labels, 2] - 1
    fewer = replace(left, weights=left.weights * (np.arange(left.weights.shape[1]) < last[:, None]))
    bits = entropy_bits(fewer, scales)
    name = "components" if left.light_bases is None else "dual_bases"
    for cluster, rank in enumerate(left.ranks[:, 2] - 1):
        row = getattr(left, name)[cluster, rank] / scales[name][cluster, rank, 0]
        bits -= entropy(row, 1.0)
    assert found < error_of(fewer, part, scales, areas) + price * bits


def with_ranks(part):
    """Say the true ranks, which the factory leaves at one."""
    ranks = np.full((part.n_clusters, 3), part.weights.shape[1], np.int32)
    if part.light_bases is not None:
        ranks[:, 0], ranks[:, 1] = part.n_view, part.light_bases.shape[2]
    return replace(part, ranks=ranks)


def test_at_no_price_that_is_paid_nothing_stays(rng, areas):
    part = with_ranks(make_part(rng, "cta", n_verts=300))
    left, scales = at_distortion(part, areas, 1e9)
    assert left.ranks[:, 1:].max() == 0
    assert all(not scale.any() for scale in scales.values())


def test_columns_of_one_size_stay_or_go_together(rng, areas):
    """Repeated singular values: a tie is no reason to keep one and leave the other."""
    part = with_ranks(make_part(rng, "cpca", n_verts=300))
    labels = np.zeros(300, np.int32)
    basis = np.linalg.qr(rng.normal(size=(300, 4)))[0] / np.sqrt(areas)[:, None]
    weights = np.zeros((300, 5), np.float32)
    weights[:, :4] = basis
    part = replace(
        part, labels=labels, weights=weights, means=part.means[:1], components=part.components[:1],
        ranks=np.array([[1, 40, 4]], np.int32),
    )  # fmt: skip
    ranks = {
        int(at_distortion(part, areas, distortion)[0].ranks[0, 2])
        for distortion in np.geomspace(1e-6, 1.0, 25)
    }
    assert ranks == {0, 4}
