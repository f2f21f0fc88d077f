"""Every method on every kind of part, through the stages of a compress job to the light it reflects."""

from copy import deepcopy

import numpy as np
import pytest

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.decode.asset import FACTORS
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.decode.relight import relight
from prtbake_storage.hdf5.bundle import read_bundle
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.jobs.compress import standalone_stages
from prtbake_workers.jobs.registry import REGISTRY
from support.local_stages import run_stages
from support.transfer_file import COEFFS, write_transfer

SIZES = {"max_iterations": 3, "n_clusters": 8, "ranks": (4, 24, 12), "n_components": 6}


@pytest.fixture(scope="module", params=[1, 3], ids=["grey", "coloured"])
def transfer(store, tmp_path_factory, request):
    """Digest of a transfer file, and its channels."""
    path = write_transfer(tmp_path_factory.mktemp("methods"), n_channels=request.param)
    return store.put_file(path, move=False), request.param


_done = {}


def compressed(store: BlobStore, digest: str, method: str):
    """What a job left: several tests look at the same, each at its own copy."""
    if (digest, method) not in _done:
        settings = CompressSettings(method=method, **SIZES)
        results = run_stages(standalone_stages(digest, settings, 1), store)
        exact = read_asset(store.local_path(results["quantise"][0]["exact"]))
        _done[digest, method] = results, exact
    return deepcopy(_done[digest, method])


@pytest.mark.parametrize("method", FACTORS)
def test_a_method_takes_every_part_and_its_errors_are_those_of_the_files(store, transfer, method):
    digest, n_channels = transfer
    results, exact = compressed(store, digest, method)
    delivered = read_asset(store.local_path(results["quantise"][0]["asset"]))
    light = np.random.default_rng(3).standard_normal((COEFFS, 3))
    lit = relight(exact, light)
    for index, (part, result) in enumerate(zip(exact.parts, results["compress"], strict=True)):
        assert (part.method, result["method"], part.n_channels) == (method, method, n_channels)
        with open_transfer(store.local_path(digest)) as file:
            rows, source = file.read(index).astype(float), file.header.parts[index]
        n_terms, areas = source.n_terms, source.areas
        assert (n_terms > 1) == (index == 0)
        if method != "cta":
            assert part.n_view == n_terms
        energy = areas @ np.sum(rows**2, axis=(1, 2))
        found = reconstruct(part, slice(None))
        ratio = areas @ np.sum((found - rows) ** 2, axis=(1, 2)) / energy
        # float32 factors against float64 sums
        assert result["errors"][part.name] == pytest.approx(ratio, rel=1e-3)
        assert 0.0 < ratio < 0.5
        stored = sum(a.nbytes for name, a in part.factors() if name != "labels")
        known = 0 if method == "cta" else part.view_basis.nbytes
        assert stored == result["factor_bytes"] + known
        # the factors of the task are the asset's
        factors, _ = read_bundle(store.local_path(result["factors"]))
        assert all(np.array_equal(getattr(part, name), factors[name]) for name in factors)
        rounded = reconstruct(delivered.parts[index], slice(None))
        rounding = areas @ np.sum((rounded - found) ** 2, axis=(1, 2)) / energy
        assert results["quantise"][0]["errors"][part.name] == pytest.approx(rounding, rel=1e-3)
        # a hundredth of what compression leaves, view texture included
        assert 0.0 < rounding <= 0.01 * ratio
        assert {"weights", "components"} & set(delivered.parts[index].precision.bits) == (
            {"vq": set(), "cta": {"weights"}}.get(method, {"weights", "components"})
        )
        # what is relit is the reconstruction's product with the light
        by_channel = found.reshape(len(rows), n_channels, n_terms, COEFFS).astype(float)
        by_channel = np.broadcast_to(by_channel, (len(rows), 3, n_terms, COEFFS))
        expected = np.einsum("vckl,lc->vkc", by_channel, light)
        relit = np.einsum("kr,vrc->vkc", part.view_basis, lit[index])
        atol = 3e-5 * np.abs(expected).max()
        np.testing.assert_allclose(relit, expected, rtol=0, atol=atol)
        assert np.abs(relit[::-1] - expected).max() > 1e3 * atol


def test_more_factors_err_less(store, transfer):
    """Of the four at these sizes; and one method's factors are not another's."""
    digest, _ = transfer
    errors = {
        method: compressed(store, digest, method)[0]["compress"][0]["errors"]["object"]
        for method in ("vq", "pca", "cpca")
    }
    assert errors["cpca"] < min(errors["vq"], errors["pca"])


@pytest.mark.parametrize("method", FACTORS)
def test_an_estimate_knows_the_bytes_of_every_method(store, transfer, method):
    digest, _ = transfer
    results, exact = compressed(store, digest, method)
    body = {"kind": "compress", "transfer": "job/transfer.h5"}
    body["settings"] = CompressSettings(method=method, **SIZES).model_dump(mode="json")
    given = {"artefacts": {"transfer": {"digest": digest}}}
    stages = REGISTRY.stages("estimate", {"request": body}, given)
    estimate = run_stages(stages, store)["estimate"][0]
    planned = estimate["plan"]["parts"][0]["compression"]
    assert planned["method"] == method
    assert planned["n_clusters"] == exact.parts[0].n_clusters
    # gzip finds more to win in a small smooth file than in those that the shares are from
    made = results["quantise"][0]["bytes"]
    assert 0.95 * made < estimate["artefact_bytes"]["asset.h5"] < 1.6 * made
    assert estimate["total_seconds"] > 0
