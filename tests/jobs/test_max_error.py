"""An error that is asked for, through the stages of a compress job to the file that is delivered."""

import numpy as np
import pytest
from pydantic import ValidationError

from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.jobs.compress import standalone_stages
from prtbake_workers.jobs.delivered import delivered_errors, write_delivered
from prtbake_workers.jobs.rounding import options
from support.local_stages import run_stages
from support.transfer_file import write_transfer


@pytest.fixture(scope="module", params=[1, 3], ids=["grey", "coloured"])
def transfer(store, tmp_path_factory, request):
    path = write_transfer(tmp_path_factory.mktemp("max-error"), n_channels=request.param)
    return store.put_file(path, move=False)


@pytest.fixture(scope="module")
def done():
    """What was compressed so far: several tests ask for the same."""
    return {}


@pytest.fixture
def compressed(store, transfer, done):
    def run(**settings):
        given = CompressSettings(max_iterations=3, **settings)
        key = transfer, given.model_dump_json()
        if key not in done:
            done[key] = run_stages(standalone_stages(transfer, given, 1), store)
        return done[key]

    return run


@pytest.mark.parametrize("method", ["auto", "pca"])
@pytest.mark.parametrize("asked", [0.08, 0.01])
def test_every_part_ends_within_a_tenth_below_the_error(store, transfer, compressed, method, asked):
    results = compressed(method=method, max_error=asked)
    delivered = read_asset(store.local_path(results["quantise"][0]["asset"]))
    for index, part in enumerate(delivered.parts):
        with open_transfer(store.local_path(transfer)) as file:
            rows, areas = file.read(index).astype(float), file.header.parts[index].areas
        error = areas @ np.sum((reconstruct(part, slice(None)) - rows) ** 2, axis=(1, 2))
        ratio = error / (areas @ np.sum(rows**2, axis=(1, 2)))
        assert 0.9 * asked < ratio <= asked
        assert results["quantise"][0]["delivered"]["parts"][part.name] == pytest.approx(
            ratio, rel=1e-6
        )
    assert delivered.provenance["compress"]["max_error"] == asked


def test_smaller_errors_make_larger_files(compressed):
    sizes = [
        compressed(method="auto", max_error=asked)["quantise"][0]["bytes"]
        for asked in (0.08, 0.01, 0.004)
    ]
    assert sizes == sorted(sizes)


def test_rounding_steps_back_where_the_file_errs_by_more(store, transfer, compressed, tmp_path):
    """Compression that left more than it said: rounding gets less, and in the end the job fails."""
    results = compressed(method="cpca", max_error=0.02)["quantise"][0]
    exact = read_asset(store.local_path(results["exact"]))
    with open_transfer(store.local_path(transfer)) as file:
        errors = list(delivered_errors(file, exact)["parts"].values())
        energies = [
            float(part.areas @ np.sum(file.read(index).astype(float) ** 2, axis=(1, 2)))
            / float(part.areas.sum())
            for index, part in enumerate(file.header.parts)
        ]
        args = {"rounding": options(CompressSettings()), "energies": energies}

        def written(asked, left):
            given = args | {"max_error": asked, "left": left}
            return write_delivered(tmp_path / "asset.h5", exact, file, given)[1]["parts"]

        asked = 1.1 * max(errors)
        honest = written(asked, errors)
        assert all(honest[part.name] > e for part, e in zip(exact.parts, errors, strict=True))
        assert max(honest.values()) > 0.9 * asked
        # so much seems left for rounding that the first try is over
        stepped = written(asked, [0.0, 0.0])
        assert max(stepped.values()) <= asked
        with pytest.raises(RuntimeError, match=r"errs by .*, above the"):
            written(0.9 * max(errors), [0.0, 0.0])


def test_an_error_that_no_size_meets_says_what_the_best_is(compressed):
    with pytest.raises(SettingsError, match=r"cannot be met by cpca: the best of .* leaves"):
        compressed(method="cpca", max_error=1e-30)


@pytest.mark.parametrize(
    ("field", "value"),
    [("ranks", (4, 8, 8)), ("n_components", 3), ("max_quantisation_error", 0.01), ("bits", 8)],
)
def test_what_would_decide_the_error_is_refused_beside_it(field, value):
    with pytest.raises(ValidationError, match="max_error chooses"):
        CompressSettings(max_error=0.02, **{field: value})


@pytest.mark.parametrize("asked", [0.0, 1.0, -0.1])
def test_an_error_of_nothing_or_of_all_is_refused(asked):
    with pytest.raises(ValidationError, match="max_error"):
        CompressSettings(max_error=asked)
