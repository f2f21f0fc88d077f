"""Small scenes taken through the real stages, for tests that need a whole asset."""

from typing import Any

import numpy as np

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.jobs.validate import load_validation
from prtbake_workers.validation.scene import ValidationScene
from support.local_stages import registered, run_stages

NO_RESOURCE = "0" * 16
SMALL: dict[str, Any] = {
    "bake": {"cube_resolution": 12, "n_centres": 162},
    "compress": {"max_iterations": 3, "n_clusters": 4, "ranks": [4, 24, 12]},
    "fit_light": {"n_lobes": 24, "max_iterations": 1},
    "render": {"width": 64, "height": 48, "backend": "cpu"},
    "validation": {"width": 64, "height": 48, "passes": 4, "samples": 64},
}
GLOSSY = {"model": "cook_torrance", "m": 0.5, "kd": 0.3, "ks": 0.7, "f0": 0.1}


def asset_request(**changes: Any) -> dict[str, Any]:
    """A request for a small asset; ``settings`` are laid over SMALL stage by stage."""
    settings = {name: dict(fields) for name, fields in SMALL.items()}
    for stage, fields in changes.pop("settings", {}).items():
        settings[stage] |= fields
    return {
        "mesh": f"mesh-{NO_RESOURCE}",
        "brdf": GLOSSY,
        "environment": f"environment-{NO_RESOURCE}",
        "quality": "draft",
        "receiver": {"resolution": 12},
        "settings": settings,
        **changes,
    }


def context_of(
    store: BlobStore, request: dict[str, Any], mesh: dict[str, Any], environment: dict[str, Any]
) -> dict[str, Any]:
    """What the service would resolve the request's references to."""
    return {
        "mesh": registered(store, "mesh", **mesh),
        "brdf": {"spec": request["brdf"]},
        "materials": {
            name: {"spec": material["brdf"]}
            for name, material in request.get("materials", {}).items()
        },
        "environment": registered(store, "environment", **environment),
        "albedo_texture": request.get("albedo_texture"),
        "artefacts": {},
    }


def ball_context(store: BlobStore, request: dict[str, Any]) -> dict[str, Any]:
    """Resolve a request for a small ball under a procedural sky."""
    mesh = {"builtin": {"name": "icosphere", "tessellation": 2}}
    return context_of(store, request, mesh, {"builtin": {"name": "sun_sky", "width": 64}})


def teapot_context(
    store: BlobStore, request: dict[str, Any], tessellation: int = 4
) -> dict[str, Any]:
    """The teapot, at its coarsest useful tessellation or coarser, under a small procedural sky."""
    return context_of(
        store,
        request,
        {"builtin": {"name": "teapot", "tessellation": tessellation}},
        {"builtin": {"name": "sun_sky", "width": 64}},
    )


def run_asset(store: BlobStore, request: dict[str, Any], context: dict[str, Any]) -> Results:
    """Run all stages of an asset job in this process."""
    return run_stages(REGISTRY.stages("asset", request, context), store)


def run_until(
    store: BlobStore, request: dict[str, Any], context: dict[str, Any], last: str
) -> Results:
    """Run the stages of an asset job up to and including one."""
    stages = REGISTRY.stages("asset", request, context)
    names = [stage.name for stage in stages]
    return run_stages(stages[: names.index(last) + 1], store)


def validation_of(store: BlobStore, results: Results, environment: str) -> ValidationScene:
    """Everything that the chain of pictures of a finished asset needs."""
    quantised = results["quantise"][0]
    return load_validation(
        {
            "transfer": results["join"][0]["transfer"],
            "exact": quantised["exact"],
            "asset": quantised["asset"],
            "light": results["fit_light"][0]["light"],
            "environment": environment,
        },
        store,
    )


def relative_difference(a: np.ndarray, b: np.ndarray) -> float:
    """L2 norm of a - b over that of b."""
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))
