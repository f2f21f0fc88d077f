"""Errors point at fields where the request has them."""

import pytest

from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.errors import MeshError, SettingsError
from prtbake_storage.queue.context import TaskContext
from prtbake_workers.jobs.compress import stages, standalone_stages
from prtbake_workers.jobs.pointing import pointing_at
from support.local_stages import run_stages
from support.transfer_file import write_transfer

SIZES = {"max_iterations": 1, "n_clusters": 4}


@pytest.mark.parametrize(
    ("raised", "told"),
    [
        ("/settings/compress/registers", "/settings/mine/registers"),
        ("/max_error", "/settings/mine/max_error"),
        ("/lights/2/scale", "/lights/2/scale"),
        ("/environment", "/environment"),
        (None, None),
    ],
)
def test_only_pointers_at_settings_are_turned(store, tmp_path, raised, told):
    @pointing_at(CompressSettings)
    def task(_args, _context):
        raise SettingsError("no", pointer=raised)

    context = TaskContext(store, tmp_path, lambda _: None, settings_at="/settings/mine")
    with pytest.raises(SettingsError) as refused:
        task({}, context)
    assert refused.value.pointer == told

    @pointing_at(CompressSettings)
    def other(_args, _context):
        raise MeshError("no", pointer="/max_error")

    with pytest.raises(MeshError) as refused:
        other({}, context)
    assert refused.value.pointer == "/max_error"


@pytest.mark.parametrize("asked", [{"max_error": 1e-30}, {"max_bytes": 100}, {"registers": 1}])
def test_compression_points_at_the_field_of_its_kind_of_job(store, tmp_path, asked):
    transfer = store.put_file(write_transfer(tmp_path, n_channels=1))
    settings = CompressSettings(**SIZES, **asked)
    (field,) = asked
    alone = standalone_stages(transfer, settings, 1)
    with pytest.raises(SettingsError) as refused:
        run_stages(alone, store)
    assert refused.value.pointer == f"/settings/{field}"
    # the same tasks in the job of an asset, by sizes that no registers were held against
    free = standalone_stages(transfer, CompressSettings(**SIZES), 1)
    (planned,) = run_stages(free[:1], store)["plan"]
    compressions = [part["compression"] for part in planned["plan"]["parts"]]
    with pytest.raises(SettingsError) as refused:
        run_stages(stages(lambda _: (transfer, compressions), settings, 1), store)
    assert refused.value.pointer == f"/settings/compress/{field}"
