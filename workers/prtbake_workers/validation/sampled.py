"""The deterministic pictures of the chain: from sampled directions to the delivered asset."""

import numpy as np

from prtbake_storage.decode.asset import Asset
from prtbake_storage.decode.relight import relight
from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.geometry.ray_offset import ray_epsilon
from prtbake_workers.transport.reference import SurfacePoints, blocks, to_local, visible_cosine
from prtbake_workers.validation.hits import PixelHits
from prtbake_workers.validation.scene import ValidationScene
from prtbake_workers.validation.shading import shade_hits, spread, spread_lit


def sampled_terms(
    validation: ValidationScene,
    part: int,
    vertices: Int64[I64, " verts"],
    columns: Float64[F64, "dirs columns"],
) -> Float64[F64, "verts terms columns"]:
    """Contract the transfer sampled in the bake's own directions with columns of light.

    This is the bake's left side done again, plainly: psi V cos at the texel centres, V the share
    of the supersamples above the horizon that escape.
    """
    own, scene = validation.parts[part], validation.scene
    directions = validation.directions
    epsilon = ray_epsilon(scene.bounds)
    points = SurfacePoints(
        scene.ray_points[vertices], scene.normals[vertices], scene.ray_sides[vertices]
    )
    rays = directions.sub_directions(validation.supersample).astype(np.float64)
    result = np.zeros((len(vertices), own.factorisation.n_terms, columns.shape[1]))
    for block in blocks(len(vertices), directions.n, own.factorisation.n_terms):
        own_points = points.block(block)
        cosine = np.maximum(own_points.normals @ directions.directions.T, 0.0)
        if own.occluders is not None:
            free, risen = np.zeros_like(cosine), np.zeros_like(cosine)
            for sample in rays:
                risen += own_points.normals @ sample.T > 0.0
                free += visible_cosine(own_points, sample, own.occluders, epsilon) > 0.0
            cosine *= free / np.maximum(risen, 1.0)
        arriving = np.flatnonzero(cosine)
        if not len(arriving):
            continue
        wi = to_local(scene.frames[vertices[block]], directions.directions)
        psi = own.factorisation.eval_psi(wi.reshape(-1, 3)[arriving])
        psi = spread_lit(psi, arriving, cosine)
        result[block] = (psi * cosine[..., None]).transpose(0, 2, 1) @ columns
    return result


def term_picture(
    validation: ValidationScene,
    plain: Asset,
    hits: PixelHits,
    terms: list[Float64[F64, "_ _ 3"]],
) -> Float64[F64, "hits 3"]:
    """Shade from the terms that the visible vertices of every part gathered."""
    full = [spread(validation, hits, part, values) for part, values in enumerate(terms)]
    return shade_hits(plain, full, hits)


def asset_picture(
    asset: Asset, light: Float64[F64, "coeffs 3"], hits: PixelHits
) -> Float64[F64, "hits 3"]:
    """Decode an asset under whitened light."""
    return shade_hits(asset, relight(asset, light), hits)
