"""The numbers of a plan that decide how far its asset will be off."""

from prtbake_workers.planning.planned import Plan
from prtbake_workers.planning.presets import PartCompression, StageSettings
from prtbake_workers.planning.step_errors import Resolution, light_functions


def resolution_of(plan: Plan, settings: StageSettings, energy_lost: float) -> Resolution:
    """Count what `Resolution` holds; ``energy_lost`` is what the plan's terms leave.

    Compression to a given error or to bytes decides by that, and not by its sizes.
    """
    sized = settings.compress.max_error is not None or settings.compress.max_bytes is not None
    bake = settings.planned_bake
    vectors = sum(vectors_of(part.compression) for part in plan.parts)
    return Resolution(
        energy_lost=energy_lost,
        directions=6 * (bake.cube_resolution * bake.supersample) ** 2,
        functions=bake.n_coeffs,
        light_functions=light_functions(settings.fit_light),
        vectors=0 if sized else vectors,
    )


def vectors_of(compression: PartCompression) -> int:
    """Count what a part's vertices are mixed of: of tensors the vertex rank, else mean and PCs."""
    own = compression.ranks[2] if compression.method == "cta" else 1 + compression.n_components
    return compression.n_clusters * own
