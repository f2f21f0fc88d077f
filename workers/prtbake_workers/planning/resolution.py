"""The numbers of a plan that decide how far its asset will be off."""

from prtbake_workers.planning.planned import Plan
from prtbake_workers.planning.presets import StageSettings
from prtbake_workers.planning.step_errors import Resolution, light_functions


def resolution_of(plan: Plan, settings: StageSettings, energy_lost: float) -> Resolution:
    """Count what `Resolution` holds; ``energy_lost`` is what the plan's terms leave.

    Compression to a given error decides by that, and not by its sizes.
    """
    bake = settings.planned_bake
    bounced = plan.bounces is not None and plan.bounces.max_bounces > 0
    rays = plan.bounces.n_rays if plan.bounces is not None and bounced else ()
    floats = sum(part.cost.factor_floats for part in plan.parts)
    return Resolution(
        energy_lost=energy_lost,
        directions=6 * (bake.cube_resolution * bake.supersample) ** 2,
        functions=bake.n_coeffs,
        bounce_rays=sum(rays) / len(rays) if rays else 0.0,
        light_functions=light_functions(settings.fit_light),
        factor_floats=0 if settings.compress.max_error is not None else floats,
    )
