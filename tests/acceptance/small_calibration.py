"""The job kinds with a calibration of one tiny asset, for a worker of its own."""

from prtbake_workers.jobs import calibrate
from prtbake_workers.jobs.registry import REGISTRY

__all__ = ["REGISTRY"]

calibrate.TRIALS = (
    calibrate.Trial(
        {"name": "icosphere", "tessellation": 1},
        {"name": "constant", "width": 16},
        {
            "brdf": {"model": "lambert", "albedo": 0.8},
            "quality": "draft",
            "effects": {"interreflection": "off"},
            "settings": {
                "bake": {"n_centres": 42, "cube_resolution": 6},
                "fit_light": {"n_lobes": 4, "max_iterations": 1},
                "render": {"width": 32, "height": 32, "backend": "cpu"},
                "validation": {"width": 16, "height": 16, "passes": 2, "samples": 8},
            },
        },
    ),
)
