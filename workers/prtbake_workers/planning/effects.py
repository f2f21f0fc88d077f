"""Which effects a scene calls for, and why.

Every decision carries its reason, the evidence it rests on, and the error predicted if it were
the other way: the squared-error ratio in radiance norm that the effect changes, estimated from a
sparse probe of rays weighted with the part's own transfer.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from prtbake_storage.contract.settings import BakeSettings, Effects, Switch
from prtbake_storage.decode.asset import Role
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
    shape: Mesh,
    scene: Scene,
    accelerator: Accelerator,
    *,
    names: Sequence[str],
    roles: Sequence[Role],
    factorisations: Sequence[Factorisation],
    albedo: Albedo,
    watertight: bool,
    bake: BakeSettings,
    requested: Effects,
    seed: int,
    subsurface: Decision = NOTHING_SCATTERS,
    grain: Sequence[Grain | None] = (),
) -> list[Decision]:
    """Decide effect by effect for an object of one part or several, and a receiver if there is one.

    ``shape`` is the whole object before it was cut into parts; ``names`` and ``roles`` are those of
    the scene's parts.  ``albedo`` is what multiplies the light that each point sends, see
    `BounceGather`; of parts with a medium it holds the medium's, whatever ``subsurface`` decided
    before.  ``grain`` holds the frames of anisotropic parts.
    """
    part_terms = [factorisation.n_terms for factorisation in factorisations]
    decisions = [
        _self_shadowing(
            shape,
            scene,
            names,
            roles,
            factorisations,
            watertight,
            requested.self_shadowing,
            seed,
            bake.bounce_tolerance,
        ),
        _receiver_shadows(
            scene, accelerator, names, roles, factorisations, requested.receiver_shadows, seed
        ),
        _view_dependence(names, factorisations, requested.view_dependence),
        decide_frames(part_terms, grain),
    ]
    decisions += decide_bounces(
        scene,
        OpaqueSurface(scene, accelerator),
        factorisations,
        albedo,
        bake,
        requested,
        names=names,
        seed=seed + 3,
    )
    return [*decisions, subsurface]


@dataclass(frozen=True)
class _Probed:
    """What shadows take from several parts: the worst ratio, and shares of their rays together.

    ``named`` holds the share of each part by name where there are several.
    """

    ratio: float
    share: float
    rays: int
    named: dict[str, float]

    def most(self) -> str:
        """Say which part it is most of."""
        return f", most on {max(self.named, key=self.named.__getitem__)}" if self.named else ""


def _probe_parts(
    scene: Scene,
    accelerator: Accelerator,
    parts: Sequence[int],
    names: Sequence[str],
    factorisations: Sequence[Factorisation],
    seed: int,
) -> _Probed:
    found = [
        probe_occlusion(scene, accelerator, part, factorisations[part], seed=seed) for part in parts
    ]
    rays = sum(count for _, _, count in found)
    return _Probed(
        # what nothing reflects is no error
        ratio=max(
            0.0 if factorisations[part].is_black else ratio
            for part, (ratio, _, _) in zip(parts, found, strict=True)
        ),
        share=sum(share * count for _, share, count in found) / rays,
        rays=rays,
        named={names[part]: share for part, (_, share, _) in zip(parts, found, strict=True)}
        if len(parts) > 1
        else {},
    )


def _of_role(roles: Sequence[Role], role: Role) -> list[int]:
    return [part for part, own in enumerate(roles) if own == role]


def _self_shadowing(
    shape: Mesh,
    scene: Scene,
    names: Sequence[str],
    roles: Sequence[Role],
    factorisations: Sequence[Factorisation],
    watertight: bool,
    switch: Switch,
    seed: int,
    tolerance: float,
) -> Decision:
    """Decide on the light that the object, all of its parts together, takes from itself."""
    defect = convexity_defect(shape)
    closed, watertight = watertight, watertight and scene.opposite is None
    own = Accelerator(shape.positions, shape.faces)
    parts = _of_role(roles, "object")
    found = _probe_parts(scene, own, parts, names, factorisations, seed)
    black = all(factorisations[part].is_black for part in parts)
    convex = watertight and defect <= CONVEX_TOLERANCE and found.share == 0.0
    # a probe can miss shadows that are deep where they fall; this bound holds at every point
    most = float("inf")
    if watertight and not convex:
        most = max(scattered_shadows(shape, factorisations[part]) for part in parts)
    scattered = most < tolerance and found.ratio < tolerance
    taken, forced = settle(switch, not (convex or scattered or black))
    if black:
        reason = "the object is black: shadows on it are not seen"
    elif convex:
        reason = "a closed convex mesh cannot shadow itself: no ray is needed"
    elif scattered:
        reason = f"closed convex pieces far apart take at most {most:.1e} from each other"
    else:
        why = "not closed and convex" if not closed or watertight else "two-sided and dark inside"
        reason = (
            f"the mesh is {why}; {100 * found.share:.1f} % of probe rays are blocked{found.most()}"
        )
    evidence: dict[str, Any] = {
        "convexity_defect_diagonals": defect if np.isfinite(defect) else None,
        "watertight": closed,
        "probe_rays": found.rays,
        "blocked_share": found.share,
        "scattered_bound": most if np.isfinite(most) else None,
        "tolerance": tolerance,
    }
    if found.named:
        evidence["blocked_share_of"] = found.named
    return Decision(
        effect="self_shadowing",
        taken=taken,
        forced=forced,
        reason=f"forced {switch}; otherwise: {reason}" if forced else reason,
        evidence=evidence,
        predicted_error_otherwise=0.0 if convex and not forced else found.ratio,
    )


def _receiver_shadows(
    scene: Scene,
    accelerator: Accelerator,
    names: Sequence[str],
    roles: Sequence[Role],
    factorisations: Sequence[Factorisation],
    switch: Switch,
    seed: int,
) -> Decision:
    """Decide on the light that object and receiver take from each other, both ways."""
    receivers, objects = _of_role(roles, "receiver"), _of_role(roles, "object")
    if not receivers:
        return Decision("receiver_shadows", False, switch != "auto", "there is no receiver", {})
    shaded = _probe_parts(scene, accelerator, receivers, names, factorisations, seed + 1)
    plane = Accelerator(scene.positions, scene.faces[np.isin(scene.part_of_face, receivers)])
    below = _probe_parts(scene, plane, objects, names, factorisations, seed + 2)
    # a sparse probe can miss a small object on a wide plane: that a ray is blocked settles it,
    # that none is does not, so a receiver always gets its shadows unless forced off
    taken, forced = settle(switch, True)
    reason = (
        f"{100 * shaded.share:.1f} % of the probe rays from the receiver are blocked, and the "
        f"receiver blocks {100 * below.share:.1f} % of the object's{below.most()}"
    )
    evidence: dict[str, Any] = {
        "probe_rays": shaded.rays + below.rays,
        "blocked_share": shaded.share,
        "object_blocked_share": below.share,
    }
    if below.named:
        evidence["object_blocked_share_of"] = below.named
    return Decision(
        effect="receiver_shadows",
        taken=taken,
        forced=forced,
        reason=f"forced {switch}; otherwise: {reason}" if forced else reason,
        evidence=evidence,
        predicted_error_otherwise=max(shaded.ratio, below.ratio),
    )


def _view_dependence(
    names: Sequence[str], factorisations: Sequence[Factorisation], switch: Switch
) -> Decision:
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
        reason += "terms: " + ", ".join(
            f"{name} {count}" for name, count in zip(names, terms, strict=True)
        )
    return Decision(
        effect="view_dependence",
        taken=max(terms) > 1,
        forced=forced,
        reason=reason,
        evidence={"terms": terms},
        predicted_error_otherwise=max(lost, default=0.0),
    )
