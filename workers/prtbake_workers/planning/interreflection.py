"""Whether light that surfaces send to each other matters, and whether its colours do.

A sparse probe of rays follows one bounce to where its light comes from.  With T0 the direct
transfer and T1 that of the first bounce, ``sum |T1|^2 / sum |T0|^2`` is the squared-error ratio of
leaving it out; later bounces are taken to go on as the first, from part to part.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from prtbake_storage.contract.settings import BakeSettings, Effects, Switch
from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.basis.sh import eval_sh
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.ray_offset import offset_origins
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.decision import Decision, settle
from prtbake_workers.planning.probe import draw_by_area
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.hemisphere_rays import cosine_directions
from prtbake_workers.transport.surface import OpaqueSurface, interpolate_surface

VERTICES = 256
RAYS = 64
"""From every probed vertex, in two halves: their product is free of the noise of either."""

RAYS_AT_HIT = 8
PROBE_MARGIN = 1.5
"""An effect is left where it is predicted to cost so many times less than the tolerance."""

MOST_AMPLITUDE = 0.99
"""Of a bounce, over the bounce before it, for which their series is summed."""

ORDER = 5
"""Of the spherical harmonics that the bounced transfer is held in: it is smooth."""


@dataclass(frozen=True)
class BounceProbe:
    """What one bounce brings to a part.

    ``share`` is its squared norm over that of the direct transfer, ``chroma`` that of what one
    channel in place of three would miss of it, ``hit_share`` the share of rays that meet the front
    of a surface, ``variance`` the squared error of gathering it with one ray a vertex, over the
    direct transfer's squared norm; ``sent`` are the shares of what each part sends by itself.
    """

    share: float
    sent: tuple[float, ...]
    chroma: float
    hit_share: float
    variance: float
    n_rays: int


def all_bounces(probes: Sequence[BounceProbe]) -> Float64[F64, " parts"]:
    """Continue the first bounce's shares: x = a + W x for amplitudes.

    ``a`` are the square roots of the shares; what part j sends makes up its portion of a_i, and
    grows with x_j: W_ij.
    """
    first = np.sqrt([probe.share for probe in probes])
    portions = np.sqrt([probe.sent for probe in probes])
    sums = portions.sum(axis=1, keepdims=True)
    onwards = first[:, None] * np.divide(
        portions, sums, out=np.zeros_like(portions), where=sums > 0.0
    )
    if np.abs(np.linalg.eigvals(onwards)).max() >= MOST_AMPLITUDE:
        # hardly any light gets out
        return np.asarray(1e4 * first**2)
    return np.asarray(np.linalg.solve(np.eye(len(first)) - onwards, first) ** 2)


def probe_bounce(
    surface: OpaqueSurface,
    part: int,
    factorisations: Sequence[Factorisation],
    albedo: Albedo,
    *,
    seed: int,
) -> BounceProbe:
    """Follow one bounce backwards from vertices of a part, drawn by area.

    The transfer of a bounce is ``T1_k = (pi / N) sum_i psi_k(w_i) L_i`` over cosine-distributed
    rays; the radiance L_i that a hit sends is the mean of ``pi rho V Y`` over rays of its own.
    """
    scene, rng = surface.scene, np.random.default_rng(seed)
    start, stop = scene.part_ranges[part]
    count = min(VERTICES, stop - start)
    chosen = start + draw_by_area(scene.areas[start:stop], count, rng)
    local = cosine_directions(rng.random((count, RAYS, 2)))
    world = (local @ scene.frames[chosen]).reshape(-1, 3).astype(np.float32)
    origins = offset_origins(scene.ray_points[chosen], scene.ray_sides[chosen], surface.epsilon)
    hits = surface.intersect(np.repeat(origins, RAYS, axis=0), world)
    psi = factorisations[part].eval_psi(local.reshape(-1, 3))
    free = np.ones(len(world), np.bool_)
    free[hits.rays] = False
    direct = 3.0 * np.pi * float(((psi**2).sum(axis=1) * local.reshape(-1, 3)[:, 2])[free].sum())
    front = np.flatnonzero(hits.front)
    rays, triangles = hits.rays[front], hits.triangles[front]
    hit_share, n_parts = len(front) / len(world), len(factorisations)
    if len(front) == 0 or albedo.is_black or direct == 0.0:
        return BounceProbe(0.0, (0.0,) * n_parts, 0.0, hit_share, 0.0, len(world))
    # twice, from rays of their own: the product is free of the noise of either
    sent, again = (
        _sent(
            surface, triangles, hits.barycentrics[front], -world[rays].astype(np.float64),
            factorisations, albedo, rng,
        )
        for _ in range(2)
    )  # fmt: skip
    # (halves, vertices, terms, channels, coefficients)
    bounced = np.zeros((2, count, psi.shape[1], 3, ORDER**2))
    shares = []
    for sender in range(n_parts):
        own = np.flatnonzero(scene.part_of_face[triangles] == sender)
        alone = np.zeros_like(bounced)
        at = rays[own]
        np.add.at(alone, (at % 2, at // RAYS), psi[at][:, :, None, None] * sent[own][:, None])
        alone *= np.pi / (RAYS / 2)
        # the direct energy was summed over rays, the bounced one over vertices
        shares.append(max(0.0, float((alone[0] * alone[1]).sum()) * RAYS / direct))
        bounced += alone
    share = float((bounced[0] * bounced[1]).sum()) * RAYS / direct
    chroma = 0.0
    if max(albedo.n_channels, *(own.n_channels for own in factorisations)) > 1:
        beside = bounced - bounced.mean(axis=3, keepdims=True)
        chroma = float((beside[0] * beside[1]).sum()) * RAYS / direct
    single = (psi[rays] ** 2).sum(axis=1) @ (sent * again).sum(axis=(1, 2))
    variance = np.pi**2 * float(single) / direct - share
    return BounceProbe(
        max(share, 0.0), tuple(shares), max(chroma, 0.0), hit_share, max(variance, 0.0), len(world)
    )


def _sent(
    surface: OpaqueSurface,
    triangles: Int64[I64, " hits"],
    barycentrics: Float64[F64, "hits 3"],
    towards: Float64[F64, "hits 3"],
    factorisations: Sequence[Factorisation],
    albedo: Albedo,
    rng: np.random.Generator,
) -> Float64[F64, "hits 3 coeffs"]:
    """Estimate the transfer to radiance that points send towards directions."""
    scene = surface.scene
    points = interpolate_surface(scene, triangles, barycentrics)
    # the frame of the corner that weighs most
    corner = scene.faces[triangles, barycentrics.argmax(axis=1)].astype(np.int64)
    frames = scene.frames[corner]
    local = cosine_directions(rng.random((len(triangles), RAYS_AT_HIT, 2)))
    world = np.einsum("hij,hri->hrj", frames, local).reshape(-1, 3)
    origins = offset_origins(points.positions, points.side, surface.epsilon)
    blocked = surface.accelerator.occluded(
        np.repeat(origins, RAYS_AT_HIT, axis=0), world.astype(np.float32)
    )
    basis = eval_sh(ORDER, world) * ~blocked[:, None]
    basis = basis.reshape(len(triangles), RAYS_AT_HIT, -1)
    reflected = np.zeros((len(triangles), RAYS_AT_HIT, 3))
    part_of_hit = scene.part_of_face[triangles]
    wo = np.einsum("hij,hj->hi", frames, towards)
    wo[:, 2] = np.maximum(wo[:, 2], 1e-3)
    for part, factorisation in enumerate(factorisations):
        own = np.flatnonzero(part_of_hit == part)
        if len(own) == 0:
            continue
        psi = factorisation.eval_psi(local[own].reshape(-1, 3)).reshape(len(own), RAYS_AT_HIT, -1)
        if factorisation.is_constant_phi:
            reflected[own] = psi
        else:
            phi = factorisation.eval_phi(wo[own])
            reflected[own] = np.einsum("hrk,hkc->hrc", psi, phi)
    reflected *= np.pi / RAYS_AT_HIT * albedo.checked_at(triangles, barycentrics)[:, None]
    return np.asarray(np.einsum("hrc,hrb->hcb", reflected, basis))


def decide_bounces(
    scene: Scene,
    surface: OpaqueSurface,
    factorisations: Sequence[Factorisation],
    albedo: Albedo,
    bake: BakeSettings,
    requested: Effects,
    *,
    names: Sequence[str],
    seed: int,
) -> list[Decision]:
    """Decide on interreflection and on channels of its own for each colour.

    Taken where leaving it out may cost more than ``bake.bounce_tolerance`` on some part;
    ``names`` are those of the parts.
    """
    probes = [
        probe_bounce(surface, part, factorisations, albedo, seed=seed + part)
        for part in range(len(scene.part_ranges))
    ]
    shares = all_bounces(probes).tolist()
    chromas = [
        share * probe.chroma / probe.share if probe.share else 0.0
        for share, probe in zip(shares, probes, strict=True)
    ]
    share, chroma = max(shares), max(chromas)
    hit_share = max(probe.hit_share for probe in probes)
    evidence = {
        "probe_rays": sum(probe.n_rays for probe in probes),
        "hit_share": hit_share,
        "first_bounce_share": max(probe.share for probe in probes),
        "variances": [probe.variance for probe in probes],
        "tolerance": bake.bounce_tolerance,
    }
    bounces = _decision(
        "interreflection",
        requested.interreflection,
        share,
        bake.bounce_tolerance,
        _bounce_reason(albedo, hit_share, shares, names),
        evidence,
    )
    evidence = {"chroma_share": chroma, "tolerance": bake.bounce_tolerance}
    if not bounces.taken:
        reason = "no bounced light is simulated, so none has a colour"
        forced = requested.colour_bleeding != "auto"
        return [bounces, Decision("colour_bleeding", False, forced, reason, evidence, chroma)]
    reason = (
        "bounced light is as grey as what it met"
        if chroma == 0.0
        else f"one channel for all colours would miss {chroma:.1e} of the direct light's energy"
        + _of_part(chromas, names)
    )
    colours = _decision(
        "colour_bleeding",
        requested.colour_bleeding,
        chroma,
        bake.bounce_tolerance,
        reason,
        evidence,
    )
    return [bounces, colours]


def _of_part(shares: Sequence[float], names: Sequence[str]) -> str:
    """Say which part has the largest share, where there are several."""
    return f" of {names[int(np.argmax(shares))]}" if len(names) > 1 else ""


def _bounce_reason(
    albedo: Albedo, hit_share: float, shares: Sequence[float], names: Sequence[str]
) -> str:
    if albedo.is_black:
        return "every surface is black: none sends light to another"
    if hit_share == 0.0:
        return "no probe ray from a surface meets another"
    return (
        f"{100 * hit_share:.1f} % of probe rays meet a surface, and what it sends adds "
        f"{max(shares):.1e} to the direct light's energy{_of_part(shares, names)}"
    )


def _decision(
    effect: str,
    switch: Switch,
    error: float,
    tolerance: float,
    reason: str,
    evidence: Mapping[str, Any],
) -> Decision:
    taken, forced = settle(switch, PROBE_MARGIN * error > tolerance)
    return Decision(
        effect=effect,
        taken=taken,
        forced=forced,
        reason=f"forced {switch}; otherwise: {reason}" if forced else reason,
        evidence=dict(evidence),
        predicted_error_otherwise=error,
    )
