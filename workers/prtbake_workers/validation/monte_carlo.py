"""The pictures of the chain that integrate the light by sampling: from the reference to vertices.

All of them use the same light samples in the same pass.
"""

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.transport.reference import (
    LightPass,
    SurfacePoints,
    blocks,
    to_local,
    visible_cosine,
)
from prtbake_workers.validation.exact_terms import ExactTerms
from prtbake_workers.validation.hits import PixelHits
from prtbake_workers.validation.scene import ValidationPart, ValidationScene
from prtbake_workers.validation.shading import spread_lit, texture_albedo, view_terms


def pixel_pictures(
    validation: ValidationScene,
    hits: PixelHits,
    light: LightPass,
    exact: list[ExactTerms],
    epsilon: float,
) -> tuple[Float64[F64, "hits 3"], Float64[F64, "hits 3"], Float64[F64, "hits 3"]]:
    """Return (true BRDF, K exact terms, K terms by table), all lit at the pixels' own points."""
    pictures = np.zeros((3, len(hits.pixels), 3))
    albedo = texture_albedo(validation, hits)
    for index, part in enumerate(validation.parts):
        own = np.flatnonzero(hits.parts == index)
        for block in blocks(len(own), len(light.directions), part.factorisation.n_terms):
            which = own[block]
            received = visible_cosine(
                hits.points.block(which), light.directions, validation.accelerator, epsilon
            )
            arriving = np.flatnonzero(received)
            if not len(arriving):
                continue
            frames = hits.frames[which]
            wi = to_local(frames, light.directions)
            wo = np.einsum("pij,pj->pi", frames, hits.wo[which])
            lit = wi.reshape(-1, 3)[arriving]
            rho = spread_lit(
                part.brdf.eval_brdf(lit, wo[arriving // received.shape[1]]), arriving, received
            )
            true = np.einsum("ps,psc,sc->pc", received, rho, light.weights, optimize=True)
            pictures[0, which] = true * albedo[which]
            if part.factorisation.is_constant_phi:
                pictures[1:, which] = pictures[0, which]
                continue
            for row, psi, phi in (
                (1, exact[index].eval_psi(lit), exact[index].eval_phi(wo)),
                (2, part.factorisation.eval_psi(lit), view_terms(part, wo)),
            ):
                terms = _gather(spread_lit(psi, arriving, received), received, light)
                colour = np.einsum("pkc,pkc->pc", np.broadcast_to(phi, terms.shape), terms)
                pictures[row, which] = colour * albedo[which]
    return pictures[0], pictures[1], pictures[2]


def vertex_terms(
    validation: ValidationScene,
    part: ValidationPart,
    vertices: Int64[I64, " verts"],
    light: LightPass,
    epsilon: float,
) -> Float64[F64, "verts terms 3"]:
    """Gather the light of each term at vertices of the scene, with true shadows."""
    scene = validation.scene
    points = SurfacePoints(
        scene.ray_points[vertices], scene.normals[vertices], scene.ray_sides[vertices]
    )
    result = np.zeros((len(vertices), part.factorisation.n_terms, 3))
    for block in blocks(len(vertices), len(light.directions), part.factorisation.n_terms):
        received = visible_cosine(
            points.block(block), light.directions, validation.accelerator, epsilon
        )
        arriving = np.flatnonzero(received)
        if not len(arriving):
            continue
        wi = to_local(scene.frames[vertices[block]], light.directions)
        psi = part.factorisation.eval_psi(wi.reshape(-1, 3)[arriving])
        result[block] = _gather(spread_lit(psi, arriving, received), received, light)
    return result


def _gather(
    psi: Float64[F64, "points samples terms"],
    received: Float64[F64, "points samples"],
    light: LightPass,
) -> Float64[F64, "points terms 3"]:
    """Sum psi V cos L over the samples."""
    return np.asarray((psi * received[..., None]).transpose(0, 2, 1) @ light.weights)
