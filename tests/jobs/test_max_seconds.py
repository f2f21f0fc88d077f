"""Seconds that are asked for: fits end with what they have and say so; enough change nothing."""

from dataclasses import asdict

import pytest
from pydantic import ValidationError

from prtbake_storage.contract.jobs import job_request_adapter
from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs import study
from prtbake_workers.jobs.compress import compressions_of, standalone_stages
from prtbake_workers.jobs.part_budget import READS, START_SECONDS, fit_seconds
from prtbake_workers.jobs.registry import KINDS
from prtbake_workers.planning.presets import PartCompression
from support.local_stages import run_stages
from support.transfer_file import write_transfer


@pytest.fixture(scope="module")
def transfer(store, tmp_path_factory):
    path = write_transfer(tmp_path_factory.mktemp("max-seconds"), n_channels=1)
    return store.put_file(path, move=False)


def compressed(store, transfer, **settings):
    given = CompressSettings(max_iterations=6, **settings)
    return run_stages(standalone_stages(transfer, given, 1), store)


def test_without_time_one_round_is_taken_and_said(store, transfer):
    results = compressed(store, transfer, max_seconds=0.01, method="cta")
    for part in results["compress"]:
        assert part["iterations"] == 1
        assert any("max_seconds 0.01 ended the fit" in note for note in part["notes"])
    assert max(results["quantise"][0]["delivered"]["parts"].values()) < 0.2


def test_time_enough_gives_the_factors_of_none_asked_for(store, transfer):
    free = compressed(store, transfer)["compress"]
    held = compressed(store, transfer, max_seconds=3600.0)["compress"]
    assert [part["factors"] for part in held] == [part["factors"] for part in free]
    assert all(not part["notes"] for part in held)


def test_an_error_that_time_ends_is_refused_with_the_best(store, transfer):
    with pytest.raises(SettingsError, match="max_seconds ended the search"):
        compressed(store, transfer, method="cta", max_error=1e-4, max_seconds=0.01)


def test_bytes_hold_whatever_the_time(store, transfer):
    made = compressed(store, transfer, max_bytes=90_000, max_seconds=0.01)["quantise"][0]
    assert 81_000 <= made["bytes"] <= 90_000


def test_fits_share_what_reading_and_writing_leave(store, transfer):
    with open_transfer(store.local_path(transfer)) as file:
        header = file.header
    sizes = compressions_of(header, CompressSettings())
    common = {"iterations": 5, "threads": 1, "by_bytes": False}
    shares = [
        fit_seconds(100.0, header, sizes, part, read_seconds=0.0, **common) for part in range(2)
    ]
    assert sum(shares) == pytest.approx(100.0 - 3 * START_SECONDS)
    assert shares[0] > shares[1] > 0.0
    values = [part.n_vertices * part.n_rows for part in header.parts]
    slow = fit_seconds(100.0, header, sizes, 0, read_seconds=2.0, **common)
    kept = (1.0 + READS) * 2.0 * sum(values) / values[0]
    assert slow == pytest.approx(shares[0] * (1.0 - kept / sum(shares)))


@pytest.mark.parametrize("asked", [0.0, -1.0, 1e6])
def test_seconds_out_of_range_are_refused(asked):
    with pytest.raises(ValidationError, match="max_seconds"):
        CompressSettings(max_seconds=asked)


def test_what_a_clock_cuts_is_recalled_by_its_own_job_alone():
    request = {"kind": "compress", "transfer": "j/transfer.h5", "settings": {"max_iterations": 2}}
    light = {"kind": "fit_light", "environment": f"environment-{'1' * 16}", "settings": {}}
    results = Results()
    compression = asdict(PartCompression("pca", 1, (1, 1, 1), 2))
    results.add("plan", [{"plan": {"parts": [{"compression": compression}]}}], [])

    def key(base, seconds, started):
        body = base | {"settings": base["settings"] | {"max_seconds": seconds}}
        asked = job_request_adapter.validate_python(body).model_dump(mode="json")
        context = {
            "artefacts": {"transfer": {"digest": "sha256:" + "0" * 64}},
            "environment": {"canonical": "sha256:" + "0" * 64},
            "started": started,
        }
        name = "compress" if base is request else "fit_light"
        stages = {stage.name: stage for stage in KINDS[base["kind"]](asked, context)}
        return stages[name].tasks(results)[0].key

    for base in (request, light):
        assert key(base, 5.0, 1e9) == key(base, 5.0, 1e9) != key(base, 5.0, 2e9)
        assert key(base, None, 1e9) == key(base, None, 2e9)


def test_what_a_clock_cuts_in_a_study_is_recalled_by_it_alone():
    def keys(started, seconds, axes):
        base = {
            "kind": "fit_light",
            "environment": f"environment-{'1' * 16}",
            "settings": {"max_seconds": seconds, "n_lobes": 8},
        }
        body = {"kind": "study", "base": base, "axes": axes}
        request = job_request_adapter.validate_python(body)
        own = {"environment": {"canonical": "sha256:" + "0" * 64}}
        points = [{"context": 0} for _ in request.points()]
        context = {"contexts": [own], "points": points, "started": started}
        fit, *_ = study.stages(request.model_dump(mode="json"), context, KINDS)
        return {task.key for task in fit.tasks(Results())}

    lobes = {"settings.n_lobes": [8, 16]}
    assert keys(1e9, 5.0, lobes) == keys(1e9, 5.0, lobes)
    assert not keys(1e9, 5.0, lobes) & keys(2e9, 5.0, lobes)
    assert keys(1e9, None, lobes) == keys(2e9, None, lobes)
