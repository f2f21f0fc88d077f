"""What figure 7 shows: one view by three matrices and by direct integration, beside each other.

Below each matrix's picture lies its difference from the direct one.  Every pixel has the matrix of its own point, so that nothing but the projections differs.
"""

import numpy as np

from figures.comparison import HIGHEST, LIGHT_ORDER
from figures.exit_radiance import (
    Points,
    brdf_matrix,
    hemisphere_rule,
    incident_light,
    transfer,
)
from figures.projections import COMPARED, exit_functions, transfer_matrices
from prtbake_storage.contract.settings import Camera
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.ray_offset import offset_origins, ray_epsilon
from prtbake_workers.render.camera import camera_rays, framing_bounds
from prtbake_workers.render.images import (
    GAP,
    auto_exposure,
    difference_image,
    png_bytes,
    side_by_side,
    to_srgb8,
)
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.surface import above_horizon, interpolate_surface

CAMERA = Camera(azimuth_deg=20.0, elevation_deg=15.0)
BLOCK = 64
FULL_SCALE = 0.25
PANELS = COMPARED[:3]


def picture_strip(scene, accelerator, brdf, light, sizes, width):
    """Draw the scene's first part under a light, (25, 3): (a), (b), (c), and the reference.

    Returns
    -------
    bytes
        PNG; all four under the exposure of the reference.  In a difference, white is a quarter of
        the exposed range.
    """
    height = width * 5 // 8
    pixels, points, views = _seen(scene, accelerator, width, height)
    rule = hemisphere_rule(*sizes.coarser, turn=0.5)
    directions, weights = rule
    matrix = brdf_matrix(brdf, HIGHEST, *sizes.brdf)
    cube = cube_directions(sizes.cube)
    panels = np.zeros((len(PANELS) + 1, height * width, 3))
    start = 0
    for block in points.blocks(BLOCK):
        which = slice(start, start + len(block))
        start += len(block)
        own, wo = pixels[which], views[which]
        t = transfer(block, accelerator, cube, HIGHEST, LIGHT_ORDER, sizes.supersample)
        for panel, projection in zip(panels, PANELS, strict=False):
            m = transfer_matrices(projection, matrix, t, block.frames)
            panel[own] = np.einsum("pi,pij,jc->pc", exit_functions(projection, wo), m, light)
        seen = incident_light(block, accelerator, rule, LIGHT_ORDER) @ light
        rho = brdf.eval_brdf(directions[None], wo[:, None])[..., 0]
        panels[-1][own] = np.einsum("ps,psc->pc", rho * (weights * directions[:, 2]), seen)
    coverage = np.zeros(height * width, np.float32)
    coverage[pixels] = 1.0
    coverage = coverage.reshape(height, width)
    images = np.maximum(panels, 0.0).astype(np.float32).reshape(-1, height, width, 3)
    exposure = auto_exposure(images[-1], coverage)
    upper = side_by_side([to_srgb8(image, exposure) for image in images])
    scale = FULL_SCALE / exposure
    lower = side_by_side([difference_image(image, images[-1], scale) for image in images])
    gap = np.full((GAP, upper.shape[1], 3), 255, np.uint8)
    return png_bytes(np.concatenate([upper, gap, lower]))


def _seen(scene, accelerator, width, height):
    """Find the pixels that show the first part, their points, and the eye from each, locally."""
    bounds = framing_bounds(scene.positions, scene.part_ranges[:1])
    origins, rays = camera_rays(CAMERA, width, height, bounds)
    hits = accelerator.intersect(origins.astype(np.float32), rays.astype(np.float32))
    pixels = np.flatnonzero(hits.triangles >= 0)
    pixels = pixels[scene.part_of_face[hits.triangles[pixels]] == 0]
    surface = interpolate_surface(
        scene,
        hits.triangles[pixels].astype(np.int64),
        hits.barycentrics[pixels].astype(np.float64),
    )
    frames = tangent_frames(surface.normals)
    points = Points(
        offset_origins(surface.positions, surface.side, ray_epsilon(scene.bounds)),
        frames,
        np.ones(len(pixels)),
    )
    wo = above_horizon(-rays[pixels], surface.normals)
    return pixels, points, np.einsum("pij,pj->pi", frames, wo)
