"""Expected trials, passes and sizes: against what compressions of a small transfer really do."""

from collections import Counter
from functools import cache

import numpy as np
import pytest

from prtbake_storage.contract.settings import CompressSettings
from prtbake_workers.compress import cpca_iterative, lbg, to_error
from prtbake_workers.compress.coherence import coherence_of
from prtbake_workers.compress.methods import Fit, compress
from prtbake_workers.compress.to_error import compress_to_error
from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.planning.cost import factor_floats
from prtbake_workers.planning.expected_sizes import (
    OFF_BY,
    VQ_OFF_BY,
    expected_cost,
    expected_sizes,
)
from prtbake_workers.planning.presets import PartCompression, PlannedBake
from prtbake_workers.planning.search_work import (
    TRIALS,
    VQ_TRIALS,
    passes_by_error,
    searched_work,
)
from prtbake_workers.planning.stage_work import compress_work
from synthetic_transfer import synthetic_transfer

SIZE = {"n_verts": 642, "n_terms": 4, "n_coeffs": 64}
START = {
    "cta": PartCompression("cta", 4, (4, 24, 12), 1),
    "cpca": PartCompression("cpca", 4, (4, 1, 1), 12),
    "pca": PartCompression("pca", 1, (4, 1, 1), 24),
    "vq": PartCompression("vq", 40, (4, 1, 1), 0),
}
SPREAD = 1.6
"""Of counts of one transfer about those of the ones that the numbers are from."""


@cache
def transfer():
    return synthetic_transfer(**SIZE)


@pytest.fixture
def calls(monkeypatch):
    """Counts what is called of the search and of classification."""
    counted: Counter[str] = Counter()

    def count(module, name):
        real = getattr(module, name)

        def counting(*args, **fields):
            counted[name] += 1
            return real(*args, **fields)

        monkeypatch.setattr(module, name, counting)

    count(to_error, "compress")
    count(cpca_iterative, "reclassify")
    return counted


@pytest.mark.parametrize("n_components", [4, 12])
def test_passes_of_classification_by_error_are_about_as_many(calls, n_components):
    sizes = PartCompression("cpca", 6, (4, 1, 1), n_components)
    fit = Fit(seed=0, max_iterations=10, classification="iterative")
    compress("cpca", transfer(), sizes, fit)
    found = calls["reclassify"]
    predicted = sum(passes_by_error(n_components, 10, n_verts=SIZE["n_verts"]))
    assert predicted / SPREAD < found < predicted * SPREAD
    # negative twin: the static method makes none
    calls.clear()
    compress("cpca", transfer(), sizes, Fit(seed=0, max_iterations=10))
    assert calls["reclassify"] == 0
    assert passes_by_error(3, 2, n_verts=4000) == [2.0, 2.0, 2.0]
    assert passes_by_error(40, 10, n_verts=4000)[-1] == 1.0


@pytest.mark.parametrize("method", START)
@pytest.mark.parametrize("target", [0.05, 0.01])
def test_trials_and_sizes_of_a_search_are_about_those_expected(calls, method, target):
    fit = Fit(seed=0, max_iterations=6)
    found = compress_to_error(method, transfer(), START[method], fit, target)
    expected = {"vq": VQ_TRIALS, "pca": TRIALS}.get(method, TRIALS + 1.0)
    assert abs(calls["compress"] - expected) <= 2.0
    own = expected_sizes(START[method], target, **SIZE)
    made = sum(
        array.size for name, array in found.factors.items() if name not in ("labels", "ranks")
    )
    share = factor_floats(own, **SIZE) / made
    # this transfer is rougher than those that the powers are from
    most = 1.6 * (VQ_OFF_BY if method == "vq" else OFF_BY)
    assert 1.0 / most < share < most


def test_expected_sizes_grow_as_the_error_falls_and_are_those_given_without_one():
    for method, start in START.items():
        assert expected_sizes(start, None, **SIZE) is start
        floats = [
            factor_floats(expected_sizes(start, error, **SIZE), **SIZE)
            for error in (0.2, 0.05, 0.01, 0.002)
        ]
        assert floats == sorted(floats), method
        assert floats[0] < floats[-1], method
    bake = PlannedBake(n_centres=162)
    part = {"n_verts": 5000, "n_terms": 8}
    coarse, fine = (expected_cost(bake, START["cta"], error, **part) for error in (0.1, 0.001))
    assert fine.factor_floats > 5 * coarse.factor_floats
    # a search holds at least what its first trial does
    assert coarse.compress_memory_bytes >= (
        expected_cost(bake, START["cta"], None, **part).compress_memory_bytes
    )


@pytest.mark.parametrize(
    ("method", "settings", "more"),
    [
        ("cpca", {"classification": "iterative"}, {"product_flops", "solve_flops"}),
        ("cpca", {"coherence": 0.05}, {"places"}),
        ("cpca", {"overdraw_budget": 0.05}, {"moves", "solve_flops"}),
        ("cta", {"overdraw_budget": 0.05}, {"moves"}),
        ("vq", {"max_error": 0.05}, {"product_flops"}),
    ],
)
def test_what_is_asked_for_beyond_a_fit_is_counted(method, settings, more):
    own = START[method]
    own = PartCompression(
        own.method, own.n_clusters, own.ranks, own.n_components,
        settings.get("classification", "static"),
    )  # fmt: skip
    plain = searched_work(own, CompressSettings(), **SIZE)
    asked = searched_work(own, CompressSettings(**settings), **SIZE)
    if "classification" in settings:
        static = PartCompression(own.method, own.n_clusters, own.ranks, own.n_components)
        plain = searched_work(static, CompressSettings(), **SIZE)
    assert set(asked) == set(plain)
    assert {unit for unit, amount in asked.items() if amount > plain[unit]} == more
    adaptive = PartCompression("cpca", 4, (4, 1, 1), 12, "adaptive")
    iterative = PartCompression("cpca", 4, (4, 1, 1), 12, "iterative")
    works = [searched_work(one, CompressSettings(), **SIZE) for one in (iterative, adaptive)]
    assert works[0]["solve_flops"] < works[1]["solve_flops"] < 2.0 * works[0]["solve_flops"]


def test_a_plain_fit_is_counted_as_before():
    settings = CompressSettings()
    for own in START.values():
        before = compress_work(
            own, **SIZE, iterations=settings.max_iterations, threads=settings.threads
        )
        now = searched_work(own, settings, **SIZE)
        assert {unit: now[unit] for unit in before} == pytest.approx(before)
        assert now["places"] == now["moves"] == 0.0


def test_places_are_asked_for_once_an_iteration(monkeypatch):
    """Of every vertex, from the second iteration on."""
    mesh = sphere_mesh(3)
    asked = []
    real = lbg._classify_coherently
    monkeypatch.setattr(
        lbg, "_classify_coherently",
        lambda signal, *rest: (asked.append(len(signal)), real(signal, *rest))[1],
    )  # fmt: skip
    fit = Fit(seed=0, max_iterations=6, coherence=coherence_of(mesh.positions, 0.05))
    compress("cpca", np.ascontiguousarray(transfer()), START["cpca"], fit)
    counted = searched_work(
        START["cpca"], CompressSettings(coherence=0.05, max_iterations=6), **SIZE
    )["places"]
    assert 0.3 * counted < sum(asked) < counted
