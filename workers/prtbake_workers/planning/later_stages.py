"""Work and memory of the stages that no bake has: light fit, previews, validation, report."""

from collections.abc import Sequence

from prtbake_workers.planning.light_pieces import FitSamples
from prtbake_workers.planning.presets import StageSettings
from prtbake_workers.planning.seen_pixels import SeenPixels
from prtbake_workers.planning.stage_memory import (
    REPORT_BYTES,
    Lobe,
    fit_memory_bytes,
    render_memory_bytes,
    validate_memory_bytes,
)
from prtbake_workers.planning.stage_work import fit_work, render_work, validate_work

DEFAULT_TEXELS = 512 * 256
"""Of an environment whose size is not known."""

REPORT_WORK = {"tasks": 1.0}


def later_work(
    settings: StageSettings,
    *,
    n_verts: Sequence[int],
    part_terms: Sequence[int],
    seen: Sequence[SeenPixels],
    n_texels: int = DEFAULT_TEXELS,
    samples: FitSamples | None = None,
    baked_bounces: bool,
) -> dict[str, dict[str, float]]:
    """Count the work; ``n_verts`` and ``part_terms`` are those of each part."""
    return {
        "fit_light": fit_work(settings.fit_light, n_texels=n_texels, samples=samples),
        "render": render_work(
            settings.render,
            n_verts=sum(n_verts),
            n_values=sum(n * k for n, k in zip(n_verts, part_terms, strict=True)),
        ),
        "validate": validate_work(
            settings.validation,
            settings.planned_bake,
            seen=seen,
            n_terms=max(part_terms),
            n_texels=n_texels,
            baked_bounces=baked_bounces,
        ),
        "report": dict(REPORT_WORK),
    }


def later_memory(
    settings: StageSettings,
    *,
    part_terms: Sequence[int],
    lobes: Sequence[Lobe],
    seen: Sequence[SeenPixels],
    n_texels: int = DEFAULT_TEXELS,
    samples: FitSamples | None = None,
    baked_bounces: bool,
) -> dict[str, int]:
    """Predict the memory; validation is left out where no camera was looked through."""
    found = {
        "fit_light": fit_memory_bytes(settings.fit_light, n_texels=n_texels, samples=samples),
        "render": render_memory_bytes(settings.render),
        "report": REPORT_BYTES,
    }
    if seen:
        found["validate"] = validate_memory_bytes(
            settings.validation,
            seen=seen,
            part_terms=part_terms,
            lobes=lobes,
            bake=settings.planned_bake,
            n_texels=n_texels,
            baked_bounces=baked_bounces,
        )
    return found
