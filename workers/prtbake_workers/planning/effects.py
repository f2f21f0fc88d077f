"""Which effects a scene calls for, and why.

Every decision carries its reason, the evidence it rests on, and the error predicted if it were
the other way: the squared-error ratio in radiance norm that the effect changes, estimated from a
sparse probe of rays weighted with the part's own transfer.
"""

from collections.abc import Sequence

import numpy as np

from prtbake_storage.contract.settings import BakeSettings, Effects, Switch
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.spectrum import energy_lost_by_terms
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.ray_offset import offset_origins, ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.convexity import (
    CONVEX_TOLERANCE,
    convexity_defect,
    scattered_shadows,
)
from prtbake_workers.planning.decision import Decision, settle
from prtbake_workers.planning.grain import Grain, decide_frames
from prtbake_workers.planning.interreflection import decide_bounces
from prtbake_workers.planning.probe import draw_by_area
from prtbake_workers.planning.subsurface import NOTHING_SCATTERS
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.surface import OpaqueSurface

PROBE_VERTICES = 512
PROBE_RAYS = 64


def probe_occlusion(
    scene: Scene,
    accelerator: Accelerator,
    part: int,
    factorisation: Factorisation,
    *,
    seed: int,
) -> tuple[float, float, int]:
    """Estimate what shadows take from a part.

    Returns the squared-error ratio of leaving all shadows out, the share of occluded rays, and
    the ray count.  The squared transfer of a ray, summed over the terms, is
    ``sum_k psi_k^2 cos^2``; rays are cosine-distributed, so each weighs ``sum_k psi_k^2 cos``.
    """
    rng = np.random.default_rng(seed)
    start, stop = scene.part_ranges[part]
    count = min(PROBE_VERTICES, stop - start)
    chosen = start + draw_by_area(scene.areas[start:stop], count, rng)
    local, cosine = _cosine_directions(rng, count)
    frames = tangent_frames(scene.normals[chosen])
    world = np.einsum("vij,vri->vrj", frames, local).reshape(-1, 3).astype(np.float32)
    epsilon = ray_epsilon(scene.bounds)
    origins = offset_origins(scene.ray_points[chosen], scene.ray_sides[chosen], epsilon)
    blocked = accelerator.occluded(np.repeat(origins, PROBE_RAYS, axis=0), world)
    own = np.einsum("vij,vrj->vri", scene.frames[chosen], local @ frames)
    psi = factorisation.eval_psi(own.reshape(-1, 3))
    weight = (psi**2).sum(axis=1) * cosine.reshape(-1)
    lost = float((weight * blocked).sum())
    kept = float((weight * ~blocked).sum())
    ratio = lost / kept if kept > 0 else (1.0 if lost > 0 else 0.0)
    return ratio, float(blocked.mean()), int(blocked.size)


def _cosine_directions(
    rng: np.random.Generator, count: int
) -> tuple[Float64[F64, "verts rays 3"], Float64[F64, "verts rays"]]:
    u, v = rng.random((2, count, PROBE_RAYS))
    radius, angle = np.sqrt(u), 2.0 * np.pi * v
    cosine = np.sqrt(1.0 - u)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), cosine], axis=-1), cosine


def decide_effects(
    meshes: list[Mesh],
    scene: Scene,
    accelerator: Accelerator,
    *,
    factorisations: Sequence[Factorisation],
    albedo: Albedo,
    watertight: bool,
    bake: BakeSettings,
    requested: Effects,
    seed: int,
    subsurface: Decision = NOTHING_SCATTERS,
    grain: Sequence[Grain | None] = (),
) -> list[Decision]:
    """Decide effect by effect for an object (part 0) and, where there is one, its receiver.

    ``albedo`` is what multiplies the light that each point sends, see `BounceGather`; of parts with
    a medium it holds the medium's, whatever ``subsurface`` decided before.  ``grain`` holds the
    frames of anisotropic parts.
    """
    part_terms = [factorisation.n_terms for factorisation in factorisations]
    decisions = [
        _self_shadowing(
            meshes[0],
            scene,
            factorisations[0],
            watertight,
            requested.self_shadowing,
            seed,
            bake.bounce_tolerance,
        ),
        _receiver_shadows(scene, accelerator, factorisations, requested.receiver_shadows, seed),
        _view_dependence(factorisations, requested.view_dependence),
        decide_frames(part_terms, grain),
    ]
    decisions += decide_bounces(
        scene,
        OpaqueSurface(scene, accelerator),
        factorisations,
        albedo,
        bake,
        requested,
        seed=seed + 3,
    )
    return [*decisions, subsurface]


def _self_shadowing(
    mesh: Mesh,
    scene: Scene,
    factorisation: Factorisation,
    watertight: bool,
    switch: Switch,
    seed: int,
    tolerance: float,
) -> Decision:
    defect = convexity_defect(mesh)
    own = Accelerator(mesh.positions, mesh.faces)
    ratio, share, rays = probe_occlusion(scene, own, 0, factorisation, seed=seed)
    convex = watertight and defect <= CONVEX_TOLERANCE and share == 0.0
    # a probe can miss shadows that are deep where they fall; this bound holds at every point
    most = scattered_shadows(mesh, factorisation) if watertight and not convex else float("inf")
    scattered = most < tolerance and ratio < tolerance
    taken, forced = settle(switch, not (convex or scattered))
    if convex:
        reason = "a closed convex mesh cannot shadow itself: no ray is needed"
    elif scattered:
        reason = f"closed convex pieces far apart take at most {most:.1e} from each other"
    else:
        reason = f"the mesh is not closed and convex; {100 * share:.1f} % of probe rays are blocked"
    return Decision(
        effect="self_shadowing",
        taken=taken,
        forced=forced,
        reason=f"forced {switch}; otherwise: {reason}" if forced else reason,
        evidence={
            "convexity_defect_diagonals": defect if np.isfinite(defect) else None,
            "watertight": watertight,
            "probe_rays": rays,
            "blocked_share": share,
            "scattered_bound": most if np.isfinite(most) else None,
            "tolerance": tolerance,
        },
        predicted_error_otherwise=0.0 if convex and not forced else ratio,
    )


def _receiver_shadows(
    scene: Scene,
    accelerator: Accelerator,
    factorisations: Sequence[Factorisation],
    switch: Switch,
    seed: int,
) -> Decision:
    """Decide on the light that object and receiver take from each other, both ways."""
    if len(scene.part_ranges) < 2:
        return Decision("receiver_shadows", False, switch != "auto", "there is no receiver", {})
    own, other = factorisations[:2]
    ratio, share, rays = probe_occlusion(scene, accelerator, 1, other, seed=seed + 1)
    plane = Accelerator(scene.positions, scene.faces[scene.part_of_face == 1])
    below, from_object, more = probe_occlusion(scene, plane, 0, own, seed=seed + 2)
    # a sparse probe can miss a small object on a wide plane: that a ray is blocked settles it,
    # that none is does not, so a receiver always gets its shadows unless forced off
    taken, forced = settle(switch, True)
    reason = (
        f"{100 * share:.1f} % of the probe rays from the receiver are blocked, and the receiver "
        f"blocks {100 * from_object:.1f} % of the object's"
    )
    return Decision(
        effect="receiver_shadows",
        taken=taken,
        forced=forced,
        reason=f"forced {switch}; otherwise: {reason}" if forced else reason,
        evidence={
            "probe_rays": rays + more,
            "blocked_share": share,
            "object_blocked_share": from_object,
        },
        predicted_error_otherwise=max(ratio, below),
    )


def _view_dependence(factorisations: Sequence[Factorisation], switch: Switch) -> Decision:
    """Report on what the factorisations hold: ``off`` has cut them to one term each."""
    terms = [factorisation.n_terms for factorisation in factorisations]
    glossy = [found for found in factorisations if not found.is_constant_phi]
    forced = switch != "auto"
    # the first value stands alone, as a positive matrix has it: the rest is what one term lacks
    lost = [energy_lost_by_terms(found.singular_values, 1) for found in glossy]
    if not glossy:
        reason = "a Lambertian surface looks the same from everywhere"
        reason = f"forced {switch}, but there is nothing to take: {reason}" if forced else reason
    elif switch == "off":
        reason = "forced off: one term a part, whose view factor is the same for all light"
    else:
        reason = "forced on: " if forced else ""
        reason += f"terms a part: {terms}"
    return Decision(
        effect="view_dependence",
        taken=max(terms) > 1,
        forced=forced,
        reason=reason,
        evidence={"terms": terms},
        predicted_error_otherwise=max(lost, default=0.0),
    )
