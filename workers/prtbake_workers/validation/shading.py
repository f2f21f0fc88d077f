"""Shading steps that several pictures of the chain share, all by the asset's own decoder."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from prtbake_storage.decode.asset import Asset
from prtbake_storage.decode.relight import shade
from prtbake_storage.decode.texture import lookup_repeating
from prtbake_storage.decode.view_map import hemi_octahedral, lookup
from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.transport.albedo import AlbedoAt
from prtbake_workers.validation.hits import PixelHits
from prtbake_workers.validation.scene import ValidationPart, ValidationScene


def view_terms(part: ValidationPart, wo: Float64[F64, "n 3"]) -> Float64[F64, "n terms channels"]:
    """Look phi up in the pre-filtered texture, as a renderer does."""
    if part.view_texture is None:
        return part.factorisation.eval_phi(wo)
    return lookup(part.view_texture, hemi_octahedral(wo)).astype(np.float64)


def texture_albedo(validation: ValidationScene, hits: PixelHits) -> Float64[F64, "hits 3"]:
    """Return what textures and vertex colours multiply each pixel by; one where there is none."""
    albedo = np.ones((len(hits.pixels), 3))
    for index in range(len(validation.parts)):
        texture = part_texture(validation, index)
        if texture is not None:
            own = np.flatnonzero(hits.parts == index)
            albedo[own] = texture(hits.triangles[own], hits.barycentrics[own].astype(np.float64))
    return albedo


def part_texture(validation: ValidationScene, index: int) -> AlbedoAt | None:
    """Return what a part's texture and vertex colours multiply; None where it has neither."""
    part, uv = validation.finest.parts[index], validation.finest.uv
    texture = None if uv is None else part.albedo_texture
    colours, start = part.vertex_colours, part.vertex_range[0]
    if texture is None and colours is None:
        return None
    faces = validation.scene.faces

    def at(triangles: I64, barycentrics: F64) -> F64:
        corners = faces[triangles]
        tint = np.ones((len(triangles), 3))
        if texture is not None and uv is not None:
            where = np.einsum("nc,nci->ni", barycentrics, uv[corners])
            tint *= lookup_repeating(texture, where)
        if colours is not None:
            tint *= np.einsum("nc,nci->ni", barycentrics, colours[corners - start])
        return tint

    return at


def with_plain_terms(validation: ValidationScene) -> Asset:
    """Return the asset with R_view = all terms: U_view = I, phi untouched."""
    asset = validation.finest
    parts = []
    for part, true in zip(asset.parts, validation.parts, strict=True):
        start, stop = part.vertex_range
        parts.append(
            replace(
                part,
                view_basis=np.eye(true.factorisation.n_terms, dtype=np.float32),
                view_texture=true.view_texture,
                frames=validation.scene.frames[start:stop].astype(np.float32),
            )
        )
    return replace(asset, parts=tuple(parts))


def shade_hits(
    asset: Asset, radiances: Sequence[Float32[F32, "_ _ 3"]], hits: PixelHits
) -> Float64[F64, "hits 3"]:
    """Shade the hits from what the vertices gathered, one array a part."""
    colours = shade(asset, radiances, hits.triangles.astype(np.int32), hits.barycentrics, hits.wo)
    return colours.astype(np.float64)


def spread(
    validation: ValidationScene, hits: PixelHits, part: int, values: Float64[F64, "verts terms 3"]
) -> Float32[F32, "part_verts terms 3"]:
    """Lay values of the visible vertices of a part out over all of its vertices."""
    start, stop = validation.scene.part_ranges[part]
    full = np.zeros((stop - start, *values.shape[1:]), np.float32)
    full[hits.vertices_of(start, stop) - start] = values
    return full


def spread_lit(
    values: Float64[F64, "lit columns"],
    arriving: Int64[I64, " lit"],
    received: Float64[F64, "points samples"],
) -> Float64[F64, "points samples columns"]:
    """Lay out what was evaluated where light arrives; elsewhere it would meet none."""
    full = np.zeros((received.size, values.shape[1]))
    full[arriving] = values
    return full.reshape(*received.shape, -1)
