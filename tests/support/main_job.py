"""The main job on a scene small enough for a test, and what is kept of a run."""

from dataclasses import dataclass
from typing import Any

from prtbake_storage.contract.jobs import Event, Job
from support.deployment import Installation

GLOSSY = {"model": "cook_torrance", "m": 0.5, "kd": 0.3, "ks": 0.7, "f0": 0.1}
# many terms of little cost: a tile is then a few vertices, and the teapot makes nine of them
BAKE = {"cube_resolution": 16, "n_centres": 162, "n_terms": 32, "tile_vertices": 64}
SETTINGS: dict[str, Any] = {
    "bake": BAKE,
    "compress": {"max_iterations": 2, "n_clusters": 4, "ranks": [6, 24, 12]},
    "fit_light": {"n_lobes": 24, "max_iterations": 1},
    "render": {"width": 64, "height": 48},
    "validation": {
        "width": 48, "height": 36, "passes": 4, "samples": 16, "cameras": [{"name": "front"}],
    },
}  # fmt: skip
# 12,288 directions of 64 rays above every vertex: minutes, in one tile a part
HEAVY_BAKE: dict[str, Any] = {
    "kind": "bake",
    "brdf": {"model": "lambert"},
    "receiver": {"resolution": 16},
    "settings": {"cube_resolution": 64, "supersample": 8, "n_centres": 162},
}


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
