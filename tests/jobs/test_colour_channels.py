"""Transfer of three colours, through the stages of a compress job to the light it reflects."""

import numpy as np
import pytest

from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.decode.relight import relight
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.jobs.compress import standalone_stages
from support.local_stages import run_stages
from support.transfer_file import COEFFS, write_transfer

SETTINGS = CompressSettings(max_iterations=3, n_clusters=3, ranks=(5, 48, 32), n_components=24)


@pytest.fixture(scope="module")
def transfer(store, tmp_path_factory):
    """Digest of a transfer file: a glossy part of several terms and a diffuse one, both coloured."""
    path = write_transfer(tmp_path_factory.mktemp("coloured"), n_channels=3)
    return store.put_file(path, move=False)


@pytest.fixture(scope="module")
def results(store, transfer):
    return run_stages(standalone_stages(transfer, SETTINGS, 1), store)


@pytest.fixture(scope="module")
def exact(store, results):
    return read_asset(store.local_path(results["quantise"][0]["exact"]))


@pytest.fixture(scope="module")
def rows_and_areas(store, transfer):
    with open_transfer(store.local_path(transfer)) as file:
        return [
            (file.read(index).astype(float), part.areas)
            for index, part in enumerate(file.header.parts)
        ]


def test_both_methods_take_three_channels(results, exact, rows_and_areas):
    assert [part.method for part in exact.parts] == ["cta", "cpca"]
    assert [part.n_channels for part in exact.parts] == [3, 3]
    glossy, diffuse = exact.parts
    assert np.all(glossy.ranks[:, 0] == 5)
    assert np.all(diffuse.ranks[:, :2] == (1, COEFFS))
    assert glossy.view_texture.shape[2:] == (5, 1)
    for result, part, (rows, _) in zip(
        results["compress"], exact.parts, rows_and_areas, strict=True
    ):
        assert result["transfer_bytes"] == 4 * rows.size
        stored = sum(a.nbytes for name, a in part.factors() if name != "labels")
        # the view basis of a diffuse part is the number one
        assert stored == result["factor_bytes"] + (4 if part.method == "cpca" else 0)


def test_stated_errors_are_those_of_the_files(store, results, exact, rows_and_areas):
    delivered = read_asset(store.local_path(results["quantise"][0]["asset"]))
    for index, (rows, areas) in enumerate(rows_and_areas):
        part = exact.parts[index]
        energy = areas @ np.sum(rows**2, axis=(1, 2))
        found = reconstruct(part, slice(None))
        ratio = areas @ np.sum((found - rows) ** 2, axis=(1, 2)) / energy
        # float32 factors against float64 sums
        assert results["compress"][index]["errors"][part.name] == pytest.approx(ratio, rel=1e-3)
        assert ratio < 0.02
        rounded = reconstruct(delivered.parts[index], slice(None))
        rounding = areas @ np.sum((rounded - found) ** 2, axis=(1, 2)) / energy
        assert results["quantise"][0]["errors"][part.name] == pytest.approx(rounding, rel=1e-3)
        # a hundredth of what compression leaves, view texture included
        assert 0.0 < rounding <= 0.01 * ratio
        mixed = rows.reshape(len(rows), -1, 3, COEFFS).swapaxes(1, 2).reshape(rows.shape)
        if part.method == "cta":
            wrong = areas @ np.sum((found - mixed) ** 2, axis=(1, 2)) / energy
            assert wrong > 10.0 * ratio


def test_relit_colours_are_off_by_no_more_than_the_stated_error(results, exact, rows_and_areas):
    """Sum of areas |(T - T~) l|^2 <= |l|^2 sum of areas |T - T~|^2, colour by colour."""
    rng = np.random.default_rng(3)
    # near what the diffuse part reflects most, so that a wrong contraction is far off
    base = rows_and_areas[1][0][:, 0].mean(axis=0)
    light = base[:, None] * rng.uniform(0.5, 1.5, (COEFFS, 3))
    lit = relight(exact, light)
    for index, (rows, areas) in enumerate(rows_and_areas):
        part = exact.parts[index]
        stated = results["compress"][index]["errors"][part.name]
        bound = np.sum(light**2, axis=0) * stated * (areas @ np.sum(rows**2, axis=(1, 2)))
        found = np.einsum("kr,vrc->vkc", part.view_basis, lit[index])

        def off(by_channel, found=found, areas=areas):
            difference = found - np.einsum("vckl,lc->vkc", by_channel, light)
            return np.einsum("v,vkc->c", areas, difference**2)

        by_channel = rows.reshape(len(rows), 3, -1, COEFFS)
        assert np.all(off(by_channel) < bound)
        # negative twins: the channels of another colour, and terms before channels
        assert off(by_channel[:, [1, 2, 0]]).sum() > 3.0 * bound.sum()
        if part.method == "cta":
            term_major = rows.reshape(len(rows), -1, 3, COEFFS).swapaxes(1, 2)
            assert off(term_major).sum() > 3.0 * bound.sum()


def test_classification_goes_through_to_the_diffuse_part(store, transfer):
    """Fewer components than colours and vertices need, so that it matters where they are."""
    errors, sizes = [], []
    for classification in ("static", "iterative", "adaptive"):
        fields = {"n_components": 3, "n_clusters": 6, "classification": classification}
        settings = SETTINGS.model_copy(update=fields)
        made = run_stages(standalone_stages(transfer, settings, 1), store)
        (_, diffuse) = made["compress"]
        asset = read_asset(store.local_path(made["quantise"][0]["exact"]))
        (_, planned) = asset.provenance["compress"]["parts"]
        assert planned["classification"] == classification
        part = asset.parts[1]
        stored = part.ranks[:, 2] @ (np.bincount(part.labels) + 3 * COEFFS) + part.means.size
        assert diffuse["factor_bytes"] == 4 * stored
        errors.append(diffuse["errors"]["receiver"])
        sizes.append(diffuse["factor_bytes"])
    assert errors[2] <= errors[1] < errors[0]
    assert sizes[2] <= sizes[1] == sizes[0]
