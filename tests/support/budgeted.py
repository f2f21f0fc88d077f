"""Small assets with a budget: a diffuse ball whose bake is pinned, under a little sky."""

import time

from prtbake_storage.contract.jobs import job_request_adapter
from support.scenes import NO_RESOURCE, context_of

SKY = {"builtin": {"name": "sun_sky", "width": 32}}
LEFT_OPEN = {
    "bake": {"cube_resolution": 8, "n_centres": 42},
    "compress": {"max_iterations": 2},
    "fit_light": {"max_iterations": 1},
    "render": {"width": 16, "height": 16, "backend": "cpu"},
    "validation": {"width": 32, "height": 24, "passes": 4, "samples": 32},
}


def normal(budget, **changes):
    """A request as the service stores it."""
    request = {
        "kind": "asset",
        "mesh": f"mesh-{NO_RESOURCE}",
        "environment": f"environment-{NO_RESOURCE}",
        "brdf": {"model": "lambert", "albedo": 0.7},
        "budget": budget,
        "settings": LEFT_OPEN,
        **changes,
    }
    return job_request_adapter.validate_python(request).model_dump(mode="json")


def begun(store, request, tessellation=2):
    """What the service and the engine tell of a job that starts now."""
    mesh = {"builtin": {"name": "icosphere", "tessellation": tessellation}}
    return context_of(store, request, mesh, SKY) | {"started": time.time()}
