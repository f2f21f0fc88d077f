"""Random small jobs, as `cost_model` runs them: scenes, materials, qualities, effects, settings.

All of it is procedural, so that anyone can run the same jobs; the seed of a draw is its number, so
that the tenth job is the same however many are asked for.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

FIRST_SEED = 40_000
"""The jobs that shipped rates were fitted to are drawn from below this, see `Draw.of`."""

TRAINING_SEED = 20_000
"""Of jobs that the model may be mended by: those from `FIRST_SEED` on are held out."""

MESHES: tuple[dict[str, Any], ...] = (
    {"name": "icosphere", "tessellation": 3},
    {"name": "icosphere", "tessellation": 4},
    {"name": "icosphere", "tessellation": 5},
    {"name": "teapot", "tessellation": 3},
    {"name": "teapot", "tessellation": 5},
    {"name": "teapot", "tessellation": 8},
    {"name": "teapot", "tessellation": 12},
)
ENVIRONMENTS: tuple[dict[str, Any], ...] = (
    {"name": "sun_sky", "width": 64},
    {"name": "sun_sky", "width": 256},
    {"name": "hall", "width": 128},
    {"name": "constant", "width": 32},
)
BRDFS: tuple[dict[str, Any], ...] = (
    {"model": "lambert", "albedo": 0.7},
    {"model": "lambert", "albedo": [0.8, 0.3, 0.2]},
    {"model": "phong", "kd": 0.3, "ks": 0.6, "exponent": 20.0},
    {"model": "cook_torrance", "m": 0.5},
    {"model": "cook_torrance", "m": 0.3},
    {"model": "ggx", "alpha": 0.4, "kd": 0.2, "ks": 0.8},
    {"model": "ward", "alpha_x": 0.4, "alpha_y": 0.25, "ks": 0.5, "kd": 0.2},
)
EFFECTS: tuple[dict[str, str], ...] = (
    {},
    {},
    {},
    {"interreflection": "off"},
    {"interreflection": "on"},
    {"self_shadowing": "off"},
    {"view_dependence": "off"},
    {"colour_bleeding": "off"},
)
QUALITIES = ("draft", "draft", "low", "low", "medium")
MOST_TERMS = 16
"""Of a bake here: sharper BRDFs would take minutes of one job."""


@dataclass(frozen=True)
class Draw:
    """One job: its number, what to register, and the request but for the ids of that."""

    number: int
    mesh: dict[str, Any]
    environment: dict[str, Any]
    request: dict[str, Any]

    @classmethod
    def of(cls, number: int, *, first_seed: int = FIRST_SEED) -> "Draw":
        """Draw the job of a number."""
        rng = np.random.default_rng(first_seed + number)

        def one_of(choices: Any) -> Any:
            return choices[int(rng.integers(len(choices)))]

        quality = one_of(QUALITIES)
        mesh, brdf = one_of(MESHES), one_of(BRDFS)
        bake: dict[str, Any] = {}
        if rng.random() < 0.3:
            bake["n_centres"] = one_of((42, 162, 642))
        if rng.random() < 0.3:
            bake["cube_resolution"] = one_of((12, 16, 24, 32))
        if rng.random() < 0.15:
            bake = {"cube_resolution": "auto", "n_centres": "auto"}
        if brdf["model"] != "lambert":
            bake["n_terms"] = int(rng.integers(2, MOST_TERMS + 1))
        receiver = {"resolution": int(rng.integers(6, 49))} if rng.random() < 0.6 else None
        request: dict[str, Any] = {
            "kind": "asset",
            "brdf": brdf,
            "quality": quality,
            "receiver": receiver,
            "effects": one_of(EFFECTS),
            "seed": number,
            "settings": {
                "bake": bake,
                "fit_light": {"n_lobes": int(rng.integers(12, 129))},
                "render": {
                    "width": int(rng.integers(10, 41)) * 16,
                    "height": int(rng.integers(8, 31)) * 16,
                    "turntable_frames": one_of((0, 0, 0, 4)),
                },
                "validation": {
                    "width": int(rng.integers(4, 13)) * 16,
                    "height": int(rng.integers(3, 10)) * 16,
                    "passes": int(rng.integers(2, 9)),
                },
            },
        }
        if brdf["model"] == "lambert" and rng.random() < 0.25:
            request["subsurface"] = {"medium": "marble", "mm_per_unit": float(rng.choice([1, 4]))}
        return cls(number, dict(mesh), dict(one_of(ENVIRONMENTS)), request)
