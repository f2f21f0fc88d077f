"""One installation as users start it, and the main job that ran on it undisturbed."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest
from support.deployment import Installation, installed, without_settings

from prtbake_storage.contract.jobs import Event, Job

GLOSSY = {"model": "cook_torrance", "m": 0.5, "kd": 0.3, "ks": 0.7, "f0": 0.1}
# many terms of little cost: a tile is then a few vertices, and the teapot makes nine of them
BAKE = {"cube_resolution": 16, "n_centres": 162, "n_terms": 32, "tile_vertices": 64}
SETTINGS: dict[str, Any] = {
    "bake": BAKE,
    "compress": {"max_iterations": 2, "n_clusters": 4, "ranks": [6, 24, 12]},
    "fit_light": {"n_lobes": 24, "max_iterations": 1},
    "render": {"width": 64, "height": 48},
    "validation": {
        "width": 64, "height": 48, "passes": 4, "samples": 32, "cameras": [{"name": "front"}],
    },
}  # fmt: skip


@dataclass(frozen=True)
class Finished:
    """A job at its end and all that was heard of it on the way."""

    job: Job
    events: list[Event]


def main_request(installation: Installation) -> dict[str, Any]:
    """The main job on a small scene, the same for every installation."""
    return {
        "kind": "asset",
        "label": "a glossy teapot",
        "mesh": installation.mesh,
        "brdf": GLOSSY,
        "environment": installation.environment,
        "receiver": {"resolution": 12},
        "quality": "draft",
        "settings": SETTINGS,
    }


@pytest.fixture(scope="session", autouse=True)
def _no_settings_of_the_user() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in without_settings(kept=("PRTBAKE_DATA", "PRTBAKE_TEST_POSTGRES_URL")):
            patch.delenv(name)
        yield


@pytest.fixture(scope="session")
def local(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    """A service and two workers with the settings they come with."""
    with installed(tmp_path_factory.mktemp("local")) as installation:
        yield installation


@pytest.fixture(scope="session")
def undisturbed(local: Installation) -> Finished:
    """The main job, followed from submission to end."""
    job = local.client.submit(main_request(local))
    events = list(local.client.events(job.id))
    return Finished(local.client.job(job.id), events)
