"""What a service process opens."""

from pathlib import Path

from prtbake_service.backend import Backend
from prtbake_service.health.metrics import Metrics
from prtbake_service.testing import quick_settings


def test_each_process_leaves_its_unfinished_files_under_a_name_of_its_own(tmp_path: Path) -> None:
    settings = quick_settings(tmp_path)
    owners = set()
    for _ in range(2):
        backend = Backend.open(settings, Metrics())
        with backend.blobs.scratch() as folder:
            owners.add(folder.parent.name)
        backend.close()
    assert len(owners) == 2
    assert all(owner.startswith("service-") for owner in owners)
