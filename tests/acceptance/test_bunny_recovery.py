"""The same deaths in the middle of the bunny's bake, at the settings of Tsai and Shih's table 1.

Three asset jobs of minutes each: ``make bunny PRTBAKE_DATA=...`` runs them, nothing else does.
"""

from pathlib import Path
from typing import Any

import pytest

from prtbake_storage.contract.jobs import Job
from support.deployment import EAGER, Installation, installed
from support.disturbance import leaves_nothing_when_canceled, survives_a_kill
from support.main_job import GLOSSY

pytestmark = [
    pytest.mark.acceptance,
    pytest.mark.real_data,
    pytest.mark.long,
    pytest.mark.timeout(2 * 3600),
]

BAKE = {"cube_resolution": 32, "n_centres": 642, "n_terms": 16}
COMPRESSION = {"n_clusters": 97, "ranks": [8, 48, 24]}
PICTURES = {"width": 64, "height": 48, "passes": 2, "samples": 16, "cameras": [{"name": "front"}]}
PATIENCE_S = 3600.0


@pytest.fixture(scope="module")
def undisturbed(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Job:
    """The job's end on an installation that nobody disturbs."""
    with installed(tmp_path_factory.mktemp("undisturbed"), settings=EAGER) as installation:
        job_id = installation.client.submit(bunny_request(installation, data_dir)).id
        return installation.client.wait(job_id, timeout_s=PATIENCE_S)


def test_the_bunny_survives_a_kill(
    undisturbed: Job, installation: Installation, data_dir: Path
) -> None:
    request = bunny_request(installation, data_dir)
    survives_a_kill(installation, request, undisturbed, patience_s=PATIENCE_S)


def test_the_bunny_leaves_nothing_when_canceled(installation: Installation, data_dir: Path) -> None:
    # another seed: nothing of it is remembered
    request = bunny_request(installation, data_dir) | {"seed": 7}
    leaves_nothing_when_canceled(installation, request)


def bunny_request(installation: Installation, data_dir: Path) -> dict[str, Any]:
    """Give the job of docs/results.md, but for the size of its pictures."""
    field = data_dir / "environments" / "kloppenheim_05_1k.hdr"
    return {
        "kind": "asset",
        "mesh": installation.client.add_mesh(data_dir / "meshes" / "stanford-bunny.obj").id,
        "brdf": GLOSSY,
        "environment": installation.client.add_environment(field).id,
        "receiver": {"resolution": 96},
        "quality": "medium",
        "settings": {"bake": BAKE, "compress": COMPRESSION, "validation": PICTURES},
    }
