"""Predicted sizes against those of real factors."""

import numpy as np
import pytest

from prtbake_workers.compress.cpca import compress_cpca
from prtbake_workers.compress.cta import CtaRanks, compress_cta
from prtbake_workers.compress.pca import compress_pca
from prtbake_workers.compress.vq import compress_vq
from prtbake_workers.planning.cost import (
    CHILD_BYTES,
    HELD_BYTES,
    compress_memory_bytes,
    part_cost,
    plan_memory_bytes,
    tile_memory_bytes,
)
from prtbake_workers.planning.presets import PartCompression, PlannedBake

VERTS, COEFFS = 120, 42
BAKE = PlannedBake(n_centres=COEFFS)


def cost_of(method, n_terms, n_channels):
    clusters, components = {"pca": (1, 4), "vq": (3, 0)}.get(method, (3, 4))
    compression = PartCompression(method, clusters, (2, 6, 5), components)
    return part_cost(
        BAKE, compression, n_verts=VERTS, n_terms=n_terms, n_channels=n_channels
    )  # fmt: skip


@pytest.mark.parametrize("n_channels", [1, 3])
def test_the_asset_s_bytes_are_those_of_the_factors_in_16_bits(rng, n_channels):
    transfer = rng.standard_normal((VERTS, 4 * n_channels, COEFFS)).astype(np.float32)
    cta = compress_cta(
        transfer, 3, CtaRanks(2, 6, 5), seed=0, max_iterations=1, n_channels=n_channels
    )
    cost = cost_of("cta", 4, n_channels)
    assert 4 * cost.factor_floats == cta.nbytes
    assert 2 * cost.transfer_bytes == transfer.nbytes
    signal = np.ascontiguousarray(transfer[:, :n_channels]).reshape(VERTS, -1)
    cpca = compress_cpca(signal, 3, 4, seed=0)
    cost = cost_of("cpca", 1, n_channels)
    assert 4 * cost.factor_floats == cpca.nbytes
    assert 2 * cost.transfer_bytes == signal.nbytes
    rows = transfer.reshape(VERTS, -1)
    several = compress_cpca(rows, 3, 4, seed=0)
    assert 4 * cost_of("cpca", 4, n_channels).factor_floats == several.nbytes
    pca = compress_pca(rows, 4, seed=0)
    assert 4 * cost_of("pca", 4, n_channels).factor_floats == pca.nbytes
    vq = compress_vq(rows, 3, seed=0)
    assert 4 * cost_of("vq", 4, n_channels).factor_floats == vq.nbytes


@pytest.mark.parametrize(("method", "n_terms"), [("cta", 4), ("cpca", 1)])
def test_three_channels_take_more_memory_and_bytes(method, n_terms):
    one, three = (cost_of(method, n_terms, n_channels) for n_channels in (1, 3))
    assert three.transfer_bytes == 3 * one.transfer_bytes
    # Gram matrices of a cluster's vertices are no larger
    assert 2 * one.compress_memory_bytes < three.compress_memory_bytes
    assert three.compress_memory_bytes < 5 * one.compress_memory_bytes
    assert compress_memory_bytes([one, three]) - compress_memory_bytes([one]) == (
        three.compress_memory_bytes - one.compress_memory_bytes
    )
    assert one.factor_floats < three.factor_floats < 3 * one.factor_floats


def test_transfer_that_is_read_takes_no_memory_of_its_own():
    """Beyond a GiB it is what a thread reads at a time that counts, and the largest cluster."""
    bake = PlannedBake(n_centres=642)

    def memory(n_verts: int) -> int:
        compression = PartCompression("cta", n_verts // 360, (8, 48, 24), 4)
        return part_cost(bake, compression, n_verts=n_verts, n_terms=16).compress_memory_bytes

    below, above, twice = memory(26_000), memory(35_000), memory(70_000)
    assert 4 * 26_000 * 16 * 642 < HELD_BYTES < 4 * 35_000 * 16 * 642 < 2 * below
    assert above < below / 2
    assert twice < 1.1 * above


def test_costs_go_by_the_coefficients_of_either_basis():
    """36 harmonics take less of everything than 42 SRBFs, in proportion where it is linear."""
    settings = PlannedBake(basis="sh", sh_order=6)
    compression = PartCompression("cta", 3, (2, 6, 5), 4)
    few, more = (
        part_cost(bake, compression, n_verts=VERTS, n_terms=4) for bake in (settings, BAKE)
    )
    assert few.transfer_bytes * 42 == more.transfer_bytes * 36
    assert few.compress_memory_bytes < more.compress_memory_bytes
    assert plan_memory_bytes(settings) < plan_memory_bytes(BAKE)
    assert tile_memory_bytes(settings, n_terms=4, n_verts=VERTS) < tile_memory_bytes(
        BAKE, n_terms=4, n_verts=VERTS
    )


def test_tensors_take_what_stands_side_by_side():
    """Measured on jobs with two threads, MB: transfer, its view and chunks, and their clusters."""
    low, medium = (
        BAKE.model_copy(update={"n_centres": 162}),
        BAKE.model_copy(update={"n_centres": 642}),
    )
    sphere, teapot = 10_242, 4_658
    for bake, n_verts, n_terms, clusters, ranks, measured in (
        (medium, sphere, 14, 28, (8, 48, 24), 955e6),
        (medium, sphere, 12, 21, (6, 32, 16), 847e6),
        (medium, teapot, 15, 13, (15, 83, 42), 802e6),
        (low, sphere, 15, 14, (12, 28, 14), 575e6),
        (low, sphere, 3, 21, (3, 32, 16), 259e6),
    ):
        compression = PartCompression("cta", clusters, ranks, n_components=0)
        cost = part_cost(bake, compression, n_verts=n_verts, n_terms=n_terms)
        assert compress_memory_bytes([cost]) == pytest.approx(measured, rel=0.12)
        # negative twin: without what threads work on it is less
        assert 4 * n_verts * bake.n_coeffs * (n_terms + ranks[0]) + CHILD_BYTES < 0.88 * measured
