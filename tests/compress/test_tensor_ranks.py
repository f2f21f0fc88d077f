"""Ranks of clusters of tensors, beside every choice there is."""

from itertools import product

import numpy as np
import pytest

from prtbake_workers.compress.tensor_ranks import MOST_STEPS, allocate_tensor_ranks, rank_choices

N_COEFFS = 20


def cores(rng, n, shape=(3, 1, 2, 3)):
    """Cores whose entries fall along every axis, some more steeply, some stronger."""
    found = []
    for _ in range(n):
        fall = rng.uniform(0.5, 3.0)
        vert, _, view, light = np.ogrid[tuple(slice(1, size + 1) for size in shape)]
        scale = rng.lognormal() * (vert * view * light) ** -fall
        found.append(scale * rng.standard_normal(shape))
    return found


def held(core, ranks):
    """Squared norm of a leading block: the oracle, from the definition."""
    view, light, vert = ranks
    return float(np.sum(core[:vert, :, :view, :light] ** 2))


def stored(core, n_verts, ranks):
    """Numbers of the light basis, the dual basis and the weights."""
    view, light, vert = ranks
    return N_COEFFS * light + core.shape[1] * view * light * vert + n_verts * vert


@pytest.mark.parametrize("n_channels", [1, 3])
def test_choices_are_those_of_leading_blocks(rng, n_channels):
    (core,) = cores(rng, 1, (4, n_channels, 2, 5))
    own = rank_choices(core, 7, N_COEFFS)
    assert own.captured.shape == own.numbers.shape == (2, 5, 4)
    assert [ranks.tolist() for ranks in own.ranks] == [[1, 2], [1, 2, 3, 4, 5], [1, 2, 3, 4]]
    for ranks in product(range(1, 3), range(1, 6), range(1, 5)):
        place = tuple(rank - 1 for rank in ranks)
        assert own.captured[place] == pytest.approx(held(core, ranks), rel=1e-12)
        assert own.numbers[place] == stored(core, 7, ranks)


def test_beside_every_choice_that_fits(rng):
    for _ in range(10):
        all_cores, sizes = cores(rng, 3), rng.integers(3, 30, 3)
        own = [
            rank_choices(core, int(n), N_COEFFS) for core, n in zip(all_cores, sizes, strict=True)
        ]
        found = allocate_tensor_ranks(own, 200.0)
        used = sum(
            stored(core, n, ranks) if ranks.any() else 0
            for core, n, ranks in zip(all_cores, sizes, found.ranks, strict=True)
        )
        assert found.numbers == used <= 200.0
        won = sum(held(core, ranks) for core, ranks in zip(all_cores, found.ranks, strict=True))
        blocks = [(0, 0, 0), *product(range(1, 3), range(1, 4), range(1, 4))]
        best = 0.0
        options = [
            [(held(core, r), stored(core, n, r) if any(r) else 0) for r in blocks]
            for core, n in zip(all_cores, sizes, strict=True)
        ]
        for choice in product(*options):
            total, numbers = (sum(each) for each in zip(*choice, strict=True))
            if numbers <= 200.0:
                best = max(best, total)
        # Everett: what fits and holds more holds it in what was left over, at the price at most
        assert won <= best <= won + found.price * (200.0 - used) * (1.0 + 1e-9)


def test_even_ranks_hold_less(rng):
    """Twin: the best ranks that are the same for all, in as many numbers."""
    all_cores = cores(rng, 12, (8, 1, 3, 8))
    own = [rank_choices(core, 10, N_COEFFS) for core in all_cores]
    even = (2, 4, 4)
    budget = float(sum(stored(core, 10, even) for core in all_cores))
    found = allocate_tensor_ranks(own, budget)
    won = sum(held(core, ranks) for core, ranks in zip(all_cores, found.ranks, strict=True))
    alike = max(
        sum(held(core, ranks) for core in all_cores)
        for ranks in product(range(1, 4), range(1, 9), range(1, 9))
        if sum(stored(core, 10, ranks) for core in all_cores) <= budget
    )
    assert found.numbers <= budget
    total = sum(held(core, (3, 8, 8)) for core in all_cores)
    assert total - won < 0.5 * (total - alike)


def test_a_cluster_that_holds_nothing_gets_nothing(rng):
    (core,) = cores(rng, 1)
    own = [rank_choices(core, 5, N_COEFFS), rank_choices(0.0 * core, 5, N_COEFFS)]
    empty = rank_choices(np.zeros((0, 1, 2, 3)), 0, N_COEFFS)
    found = allocate_tensor_ranks([*own, empty], 1e6)
    # true ranks, although there were numbers for more
    assert found.ranks.tolist() == [[2, 3, 3], [0, 0, 0], [0, 0, 0]]
    assert not allocate_tensor_ranks(own[1:], 1e6).ranks.any()
    assert not allocate_tensor_ranks(own, 0.0).ranks.any()


def test_ranks_end_where_the_core_does(rng):
    (core,) = cores(rng, 1, (6, 1, 3, 6))
    core[:, :, :, 4:] = 0.0
    core[5:] = 0.0
    found = allocate_tensor_ranks([rank_choices(core, 5, N_COEFFS)], 1e6)
    assert found.ranks.tolist() == [[3, 4, 5]]


def test_of_many_ranks_some_are_offered(rng):
    (core,) = cores(rng, 1, (3, 1, 2, 200))
    own = rank_choices(core, 7, N_COEFFS)
    light = own.ranks[1]
    assert light[0] == 1
    assert light[-1] == 200
    assert len(light) == MOST_STEPS
    assert np.diff(light).max() <= 7
    for index, rank in enumerate(light):
        assert own.captured[1, index, 2] == pytest.approx(held(core, (2, rank, 3)), rel=1e-12)
