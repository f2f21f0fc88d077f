"""Bits by what errors weigh: the bound is met, nearly used up, and no other bits are fewer."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.decode.quantise import SHARED_AXES, bits_of, peak_scales, round_part
from prtbake_workers.compress.bit_allocation import LEAST_SHARE, allocate_bits, measured
from prtbake_workers.compress.cta import CtaRanks, compress_cta
from support.rounded_parts import dense, make_part

KINDS = [("cta", 1), ("cta", 3), ("cpca", 1), ("cpca", 3)]


def energy_of(part, areas):
    return float(areas @ (dense(part) ** 2).sum(axis=(1, 2, 3)))


def rate(part, scales):
    """Bits of all levels were every column of every cluster Gaussian, coded by its entropy."""
    bits = 0.0
    for name, scale in scales.items():
        array = getattr(part, name).astype(np.float64)
        if name == "weights":
            for cluster, steps in enumerate(scale):
                own = array[part.labels == cluster]
                bits += len(own) * gaussian_bits((own**2).mean(axis=0), steps).sum()
            continue
        axes = SHARED_AXES[name]
        power = (array**2).mean(axis=axes, keepdims=True)
        bits += gaussian_bits(power, scale).sum() * array.size / power.size
    return float(bits)


def gaussian_bits(variance, step):
    return 0.5 * np.log2(1.0 + 2.0 * np.pi * np.e * variance / np.maximum(step, 1e-30) ** 2)


@pytest.mark.parametrize(("method", "channels"), KINDS)
@pytest.mark.parametrize("bound", [1e-1, 1e-3, 1e-5, 1e-7])
def test_the_error_is_within_a_bound_and_near_it(rng, method, channels, bound):
    part = make_part(rng, method, n_verts=300, n_channels=channels)
    areas = rng.uniform(0.1, 3.0, part.n_vertices)
    energy = energy_of(part, areas)
    found = allocate_bits(part, areas, bound * energy)
    assert found.meets
    assert LEAST_SHARE * bound <= found.error.total / energy <= bound
    again = measured(part, found.scales, areas)
    assert again == found.error
    if bound <= 1e-3:
        assert found.foreseen == pytest.approx(found.error.total, rel=0.1)


def test_real_factors(glossy):
    """Clustered tensor approximation of the bumpy sphere: fewer bits where columns are weak."""
    model = compress_cta(glossy, 6, CtaRanks(6, 20, 12), seed=1, max_iterations=3)
    part = make_part(np.random.default_rng(0), "cta", n_verts=len(glossy))
    names = ("view_basis", "light_bases", "dual_bases", "weights", "labels", "ranks")
    part = replace(
        part, view_texture=None, frames=None, **{name: getattr(model, name) for name in names}
    )
    areas = np.ones(len(glossy))
    bound = 0.01 * model.objective[-1]
    found = allocate_bits(part, areas, bound)
    assert found.meets
    assert LEAST_SHARE * bound <= found.error.total <= bound
    bits = [bits_of(column) for column in round_part(part, found.scales)["weights"].T]
    assert bits[0] >= bits[-1] + 2
    assert max(bits) <= 12


@pytest.mark.parametrize("method", ["cta", "cpca"])
def test_no_factor_gains_by_bits_of_the_others(rng, method):
    """Shift bits towards or away from a factor at the same error: more bits in all."""
    part = make_part(rng, method, n_verts=4000)
    areas = rng.uniform(0.1, 3.0, part.n_vertices)
    found = allocate_bits(part, areas, 1e-4 * energy_of(part, areas))
    fewest = rate(part, found.scales)
    for name in found.scales:
        for factor in (0.5, 2.0):
            tilted = dict(found.scales)
            tilted[name] = tilted[name] * np.float32(factor)
            assert rate(part, at_error(part, areas, tilted, found)) > fewest, (name, factor)
    # negative twin: as many bits for every column are not the fewest
    even = at_error(part, areas, peak_scales(part, 7), found)
    assert rate(part, even) > 1.05 * fewest


def at_error(part, areas, scales, found):
    """Multiply all scales until the error is that of ``found``."""
    factor = 1.0
    for _ in range(6):
        tried = {name: (own * np.float32(factor)) for name, own in scales.items()}
        factor *= np.sqrt(found.error.total / measured(part, tried, areas).total)
    return tried


def test_columns_of_zeros_stay_zero(rng):
    part = make_part(rng, "cta")
    weights, dual = part.weights.copy(), part.dual_bases.copy()
    weights[:, -1], dual[:, -1] = 0.0, 0.0
    part = replace(part, weights=weights, dual_bases=dual)
    areas = np.ones(part.n_vertices)
    energy = energy_of(part, areas)
    found = allocate_bits(part, areas, 1e-4 * energy)
    assert LEAST_SHARE * 1e-4 <= found.error.total / energy <= 1e-4
    assert np.all(found.scales["weights"][:, -1] == 0.0)
    assert np.all(round_part(part, found.scales)["dual_bases"][:, -1] == 0)


def test_columns_below_the_bound_are_dropped(rng):
    """One column 1e8 above the others: they are 1e-16 of the energy."""
    part = make_part(rng, "cpca")
    weights = part.weights.copy()
    weights[:, 0] *= 1e8
    part = replace(part, weights=weights)
    areas = np.ones(part.n_vertices)
    energy = energy_of(part, areas)
    found = allocate_bits(part, areas, 1e-6 * energy)
    assert LEAST_SHARE * 1e-6 <= found.error.total / energy <= 1e-6
    assert np.all(found.scales["weights"][:, 1:] == 0.0)
    assert np.all(found.scales["weights"][:, 0] > 0.0)
    # negative twin: with columns of like size none is dropped
    even = make_part(rng, "cpca")
    kept = allocate_bits(even, areas, 1e-6 * energy_of(even, areas))
    assert np.all(kept.scales["weights"] > 0.0)


@pytest.mark.parametrize("size", [1e-18, 1e-30, 1e15])
def test_scales_far_from_one(rng, size):
    """1e-30 is near where scales end: what is lost there is measured, not overlooked."""
    part = make_part(rng, "cpca")
    factors = {name: getattr(part, name) for name in ("weights", "means")}
    part = replace(part, **{name: own * np.float32(size) for name, own in factors.items()})
    areas = np.ones(part.n_vertices)
    energy = energy_of(part, areas)
    found = allocate_bits(part, areas, 1e-4 * energy)
    assert found.meets == (found.error.total <= 1e-4 * energy)
    assert found.meets
    tiny = replace(part, **{name: own * np.float32(1e-38) for name, own in factors.items()})
    lost = allocate_bits(tiny, areas, 1e-4 * energy_of(tiny, areas))
    assert not lost.meets
    assert lost.error.total == pytest.approx(energy_of(tiny, areas), rel=1e-6)


@pytest.mark.parametrize("bound", [0.0, 1e-13])
def test_what_16_bits_cannot_meet_is_said(rng, bound):
    part = make_part(rng, "cta")
    areas = np.ones(part.n_vertices)
    energy = energy_of(part, areas)
    found = allocate_bits(part, areas, bound * energy)
    assert not found.meets
    # the best that can be had
    best = measured(part, peak_scales(part, 16), areas).total
    assert found.error.total == pytest.approx(best, rel=0.1)
    assert found.error.total > bound * energy


def test_a_bound_of_zero_is_met_where_levels_are_exact():
    """Whole numbers up to the largest level are levels as they are; and zeros are."""
    rng = np.random.default_rng(1)
    part = make_part(rng, "cpca", n_verts=200)
    names = ("weights", "means", "components")
    whole = {
        name: rng.integers(-32639, 32639, getattr(part, name).shape).astype(np.float32)
        for name in names
    }
    whole["means"][:, 0] = whole["components"][:, :, 0] = 32639
    whole["weights"][[np.argmax(part.labels == c) for c in range(part.n_clusters)]] = 32639
    areas = np.ones(part.n_vertices)
    for factors in (whole, {name: np.zeros_like(own) for name, own in whole.items()}):
        found = allocate_bits(replace(part, **factors), areas, 0.0)
        assert found.meets
        assert found.error.total == 0.0
    # negative twin: half a level
    whole["weights"] += np.float32(0.5)
    assert not allocate_bits(replace(part, **whole), areas, 0.0).meets


def test_vertices_without_area_keep_eight_bits(rng):
    """A cluster that no area depends on: the error does not say what it needs."""
    part = make_part(rng, "cta")
    areas = np.where(part.labels == 1, 0.0, 1.0)
    found = allocate_bits(part, areas, 1e-4 * energy_of(part, areas))
    assert found.meets
    levels = round_part(part, found.scales)
    assert bits_of(levels["weights"][part.labels == 1]) == 8
    assert bits_of(levels["light_bases"][1]) == 8
