"""What clusters take is known before they are fitted, and held against the renderer's registers."""

import numpy as np
import pytest

from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.methods import Fit, compress
from prtbake_workers.compress.superclusters import registers_of_clusters
from prtbake_workers.planning.presets import PartCompression, resolve_compression
from prtbake_workers.planning.registers import check_planned_registers, planned_registers
from synthetic_transfer import synthetic_transfer

SIZE = {"n_verts": 400, "n_terms": 3}


@pytest.mark.parametrize("method", ["vq", "pca", "cpca", "cta"])
def test_the_largest_cluster_takes_what_was_planned(method):
    rows = synthetic_transfer(400, 3, 24)
    plan = resolve_compression(
        CompressSettings(method=method, n_clusters=5, ranks=(2, 6, 5), n_components=4),
        "draft", n_coeffs=24, **SIZE,
    )  # fmt: skip
    factors = compress(method, rows, plan, Fit(seed=1, max_iterations=2)).factors
    needs = registers_of_clusters(factors["ranks"], with_mean="means" in factors)
    # by hand: numbers of the view, times weights and the mean, four to a register
    by_hand = {"vq": 3 * 1, "pca": 3 * 5, "cpca": 3 * 5, "cta": 2 * 5}[method]
    assert needs.max() == planned_registers(plan, **SIZE) == int(np.ceil(by_hand / 4))


@pytest.mark.parametrize(
    ("method", "max_error", "need"),
    [("cpca", None, 4), ("cta", None, 3), ("cpca", 0.1, 1), ("cta", 0.1, 1)],
)
def test_too_few_registers_are_refused_with_the_part(method, max_error, need):
    plan = PartCompression(method=method, n_clusters=5, ranks=(2, 6, 5), n_components=4)
    enough, few = (
        CompressSettings(method=method, max_error=max_error, registers=given)
        for given in (need, need - 1 or None)
    )
    check_planned_registers(enough, "lid", plan, **SIZE)
    if need > 1:
        message = f"registers is {need - 1}: a cluster of lid takes {need}"
        with pytest.raises(SettingsError, match=message) as refused:
            check_planned_registers(few, "lid", plan, **SIZE)
        assert refused.value.pointer == "/settings/compress/registers"


def test_ranks_that_go_by_bytes_are_open():
    plan = PartCompression(method="cta", n_clusters=5, ranks=(2, 6, 5), n_components=4)
    settings = CompressSettings(method="cta", max_bytes=10**5, registers=1)
    check_planned_registers(settings, "lid", plan, **SIZE)
    with pytest.raises(SettingsError, match="takes 3"):
        check_planned_registers(
            settings.model_copy(update={"max_bytes": None}), "lid", plan, **SIZE
        )


def test_without_registers_nothing_is_refused():
    plan = PartCompression(method="cpca", n_clusters=5, ranks=(2, 6, 5), n_components=400)
    check_planned_registers(CompressSettings(), "lid", plan, **SIZE)


def test_a_part_of_few_vertices_spans_no_more():
    plan = PartCompression(method="cpca", n_clusters=1, ranks=(1, 6, 5), n_components=40)
    assert planned_registers(plan, n_verts=3, n_terms=1) == 4
    assert planned_registers(plan, n_verts=300, n_terms=1) == 41
