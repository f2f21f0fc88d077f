"""Bytes that are asked for: the file ends just below them, with the least error, or says why not."""

from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.jobs.compress import stages, standalone_stages
from support.local_stages import run_stages
from support.transfer_file import write_transfer


@pytest.fixture(scope="module", params=[1, 3], ids=["grey", "coloured"])
def transfer(store, tmp_path_factory, request):
    path = write_transfer(tmp_path_factory.mktemp("max-bytes"), n_channels=request.param)
    return store.put_file(path, move=False)


def compressed(store, transfer, **settings):
    given = CompressSettings(max_iterations=2, **settings)
    return run_stages(standalone_stages(transfer, given, 1), store)["quantise"][0]


def ratios(store, transfer, asset):
    """Squared-error ratio of each part, from the files alone."""
    delivered, found = read_asset(store.local_path(asset)), {}
    with open_transfer(store.local_path(transfer)) as file:
        for index, part in enumerate(delivered.parts):
            rows, areas = file.read(index).astype(float), file.header.parts[index].areas
            error = areas @ np.sum((reconstruct(part, slice(None)) - rows) ** 2, axis=(1, 2))
            found[part.name] = error / (areas @ np.sum(rows**2, axis=(1, 2)))
    return found


@pytest.mark.parametrize(
    ("method", "asked"), [("auto", 55_000), ("auto", 120_000), ("pca", 70_000), ("cpca", 90_000)]
)
def test_the_file_ends_within_a_tenth_below_the_bytes(store, transfer, method, asked):
    made = compressed(store, transfer, method=method, max_bytes=asked)
    size = store.local_path(made["asset"]).stat().st_size
    assert size == made["bytes"]
    assert 0.9 * asked <= size <= asked
    measured = ratios(store, transfer, made["asset"])
    assert made["delivered"]["parts"] == pytest.approx(measured, rel=1e-6)
    provenance = read_asset(store.local_path(made["asset"])).provenance["compress"]
    assert provenance["max_bytes"] == asked


def test_vector_quantisation_fits_its_bytes(store, transfer):
    made = compressed(store, transfer, method="vq", max_bytes=60_000)
    assert 0.9 * 60_000 <= made["bytes"] <= 60_000


def test_more_bytes_make_no_larger_error(store, transfer):
    """But for a tenth: sizes of a fit change with the bytes, and its clusters with them."""
    errors, sizes = [], (50_000, 70_000, 110_000)
    for asked in sizes:
        made = compressed(store, transfer, max_bytes=asked)
        assert made["bytes"] <= asked
        errors.append(sum(made["delivered"]["parts"].values()))
    assert all(more <= 1.1 * less for less, more in pairwise(errors))
    assert errors[-1] < 0.2 * errors[0]


def test_bytes_that_mesh_and_tables_exceed_are_refused_with_the_least(store, transfer):
    with pytest.raises(SettingsError, match="mesh, tables and labels alone take") as caught:
        compressed(store, transfer, max_bytes=1000)
    least = int(caught.value.detail.split()[-1])
    # the file names the bytes that were asked for, whose digits take some themselves
    made = compressed(store, transfer, max_bytes=least + 16)
    assert 0.9 * least <= made["bytes"] <= least + 16
    with pytest.raises(SettingsError, match="alone take"):
        compressed(store, transfer, max_bytes=least - 16)


def test_more_bytes_than_there_are_numbers_end_the_file_below_them(store, transfer):
    made = compressed(store, transfer, method="cpca", max_bytes=10**12)
    assert made["bytes"] < 10**8
    assert any("takes no more" in note for note in made["notes"])
    # sizes that hold as many numbers as the transfer are not the transfer: they leave a thousandth
    assert max(made["delivered"]["parts"].values()) < 2e-3


def test_an_error_in_more_bytes_than_asked_for_is_refused_with_what_it_took(store, transfer):
    free = compressed(store, transfer, method="pca", max_error=0.05)["bytes"]
    held = {"method": "pca", "max_error": 0.05}
    # the file says what was asked for, so it is some bytes longer
    assert compressed(store, transfer, **held, max_bytes=free + 200)["bytes"] <= free + 200
    with pytest.raises(SettingsError, match=r"max_error 0\.05 took \d+") as caught:
        compressed(store, transfer, **held, max_bytes=free - 1)
    assert caught.value.pointer == "/settings/max_bytes"


def test_a_file_that_is_held_to_bytes_is_cut_where_it_takes_more(store, transfer):
    """Otherwise it is as it would be, but for the number that it names."""

    def held(most, **settings):
        given = CompressSettings(method="pca", **settings)
        (plan, *_) = standalone_stages(transfer, given, 1)
        results = run_stages([plan], store)
        parts = [part["compression"] for part in results["plan"][0]["plan"]["parts"]]
        listed = stages(lambda _: (transfer, parts), given, 1, held_to=most)
        return run_stages(listed, store)["quantise"][0]

    free = held(None)
    ample = held(10 * free["bytes"])
    assert ample["bytes"] == pytest.approx(free["bytes"], abs=64)
    assert ample["delivered"] == free["delivered"]
    asked = int(0.8 * free["bytes"])
    cut = held(asked)
    assert 0.9 * asked <= cut["bytes"] <= asked
    assert cut["delivered"]["parts"] == pytest.approx(
        ratios(store, transfer, cut["asset"]), rel=1e-6
    )
    assert max(cut["delivered"]["parts"].values()) > max(free["delivered"]["parts"].values())
    # an error stands above the bytes
    with pytest.raises(SettingsError, match=r"max_error 0\.05 took"):
        held(500, max_error=0.05)


@pytest.mark.parametrize(
    ("field", "value"),
    [("ranks", (4, 8, 8)), ("n_components", 3), ("max_quantisation_error", 0.01), ("bits", 8),
     ("bits", 16)],
)  # fmt: skip
def test_what_would_decide_the_bytes_is_refused_beside_them(field, value):
    with pytest.raises(ValidationError, match="max_bytes chooses"):
        CompressSettings(max_bytes=10**6, **{field: value})


@pytest.mark.parametrize("asked", [0, -5, 2**53])
def test_bytes_out_of_range_are_refused(asked):
    with pytest.raises(ValidationError, match="max_bytes"):
        CompressSettings(max_bytes=asked)
