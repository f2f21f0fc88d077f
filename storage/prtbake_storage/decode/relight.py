"""Relight a compressed asset in plain numpy.

The colour of a point x of cluster c seen from wo is [Tsai2006]_ eqs. (22)-(23)

    C = phi'_x(wo) . sum_j (w_x)_j uf^-1(V_c^T)_j L'_c,    L'_c = U_light,c^T l,

with l the light in the asset's orthonormal basis.  The work falls in three steps, each as seldom as
it can: `cluster_matrices` once a light (R_c = uf^-1(V_c^T)_j L'_c), `vertex_radiance` once a light
(sum over j), `shade` once a view.  Channel c of l meets channel c of the transfer in the first
step, so that the others need not know whether transfer has colours of its own.  Separable terms
carry azimuthal orders, so phi' is evaluated in every corner's own frame and the colours are mixed,
never the frames.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prtbake_storage.decode.asset import Asset, Part
from prtbake_storage.decode.light import Light
from prtbake_storage.decode.texture import lookup_repeating
from prtbake_storage.decode.transfer_basis import TransferBasis
from prtbake_storage.decode.view_map import hemi_octahedral, lookup

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

PIXELS_PER_BLOCK = 32_768
"""Bounds the memory of `shade` to some tens of MB at the paper's ranks."""


def rotation_matrix(rotation_deg: ArrayLike) -> F64:
    """Return R = Rz Ry Rx for angles about x, y, z in degrees; L'(d) = L(R^T d)."""
    x, y, z = np.radians(np.asarray(rotation_deg, dtype=np.float64))
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def project_light(basis: TransferBasis, light: Light, rotation: F64 | None = None) -> F64:
    """Project a light onto an orthonormal basis: G^(-1/2) A L of lobes on whitened SRBFs.

    Parameters
    ----------
    basis
        That of the asset.
    light
        Of any kind, or several in one (`LightSum`).
    rotation
        (3, 3); turns the light.  Lobes and harmonics turn exactly.

    Returns
    -------
    ndarray
        (coeffs, 3) linear RGB, float64.
    """
    return light.on_basis(basis, rotation)


def cluster_matrices(part: Part, light: F64) -> F32:
    """Fold the projected light (coeffs, 3) into every cluster.

    Returns
    -------
    ndarray
        (clusters, R, R_view, 3): what one unit of each weight adds to each view column.  Where
        there are means, row 0 is the mean, whose weight is 1.
    """
    channels, n_view = part.n_channels, part.n_view
    if part.light_bases is not None and part.dual_bases is not None:
        bases = part.light_bases.transpose(0, 2, 1).astype(np.float64)
        lit = bases @ light  # (clusters, R_light, 3), eq. (23)
        clusters, n_weights, _ = part.dual_bases.shape
        n_rows = n_weights * channels * n_view
        rows = part.dual_bases.reshape(clusters, n_rows, -1).astype(np.float64)
        folded = (rows @ lit).reshape(clusters, n_weights, channels, n_view, 3)
    elif part.means is not None and part.components is not None:
        rows = np.concatenate([part.means[:, None], part.components], axis=1).astype(np.float64)
        clusters, n_weights, _ = rows.shape
        rows = rows.reshape(clusters, n_weights * channels * n_view, -1)
        folded = (rows @ light).reshape(clusters, n_weights, channels, n_view, 3)
    else:
        raise ValueError(f"part {part.name!r} holds no factors")
    # every channel of the transfer met every channel of the light: keep the pairs of like ones
    own = folded[:, :, 0] if channels == 1 else np.einsum("grcvc->grvc", folded)
    return own.astype(np.float32)


def vertex_radiance(part: Part, matrices: F32) -> F32:
    """Combine a cluster's matrices by each vertex' weights, eq. (22).

    Returns
    -------
    ndarray
        (verts, R_view, 3) radiance a view column, before phi' and albedo.
    """
    weights = part.weights
    if part.means is not None:
        weights = np.concatenate([np.ones((len(weights), 1), np.float32), weights], axis=1)
    flat = matrices.reshape(*matrices.shape[:2], -1)
    radiance = np.empty((len(weights), flat.shape[2]), np.float32)
    order = np.argsort(part.labels, kind="stable")
    ends = np.cumsum(np.bincount(part.labels, minlength=len(flat)))
    for cluster, members in enumerate(np.split(order, ends[:-1])):
        radiance[members] = weights[members] @ flat[cluster]
    return radiance.reshape(len(weights), *matrices.shape[2:])


def relight(asset: Asset, light: F64) -> list[F32]:
    """Return `vertex_radiance` of every part under the projected light (coeffs, 3)."""
    return [vertex_radiance(part, cluster_matrices(part, light)) for part in asset.parts]


def shade(
    asset: Asset,
    vertex_radiances: Sequence[F32],
    triangles: I32,
    barycentrics: NDArray[np.floating],
    wo_world: NDArray[np.floating],
) -> F32:
    """Colour surface points.

    Parameters
    ----------
    asset
        Gives frames, view textures and albedo.
    vertex_radiances
        One array a part, from `vertex_radiance`.
    triangles
        (pixels,) triangle hit, -1 for none; of a two-sided part either copy.
    barycentrics
        (pixels, 3) weights of the triangle's corners.
    wo_world
        (pixels, 3) unit directions towards the eye.

    Returns
    -------
    ndarray
        (pixels, 3) linear radiance; 0 where nothing is hit or a triangle is seen from behind.

    Notes
    -----
    A corner whose normal leans away from the eye (as at every silhouette of a smooth mesh) is
    evaluated at its horizon, so that the picture stays continuous there.
    """
    colours = np.zeros((len(triangles), 3), np.float32)
    part_of_vertex = asset.part_of_vertex
    triangles, barycentrics = facing(asset, triangles, barycentrics, wo_world)
    hit = np.flatnonzero(triangles >= 0)
    hit = hit[_seen_from_front(asset, triangles[hit], wo_world[hit])]
    owner = part_of_vertex[asset.faces[triangles[hit], 0]]
    for index, (part, radiance) in enumerate(zip(asset.parts, vertex_radiances, strict=True)):
        mine = hit[owner == index]
        for start in range(0, len(mine), PIXELS_PER_BLOCK):
            pixels = mine[start : start + PIXELS_PER_BLOCK]
            corners = asset.faces[triangles[pixels]]
            weights = barycentrics[pixels].astype(np.float32)
            wo = wo_world[pixels].astype(np.float32)
            local = corners - part.vertex_range[0]
            mixed = np.zeros((len(pixels), 3), np.float32)
            for corner in range(3):
                colour = corner_colour(part, radiance, local[:, corner], wo)
                mixed += weights[:, corner, None] * colour
            colours[pixels] = mixed * _albedo(asset, part, corners, weights)
    return colours


def facing(
    asset: Asset,
    triangles: I32,
    barycentrics: NDArray[np.floating],
    wo_world: NDArray[np.floating],
) -> tuple[I32, NDArray[np.floating]]:
    """Give of each triangle of a two-sided part the copy that is seen from its front."""
    if asset.opposite is None:
        return triangles, barycentrics
    behind = np.flatnonzero((triangles >= 0) & (asset.opposite[triangles] >= 0))
    behind = behind[~_seen_from_front(asset, triangles[behind], wo_world[behind])]
    triangles, barycentrics = triangles.copy(), barycentrics.copy()
    triangles[behind] = asset.opposite[triangles[behind]]
    barycentrics[behind] = barycentrics[behind][:, ::-1]
    return triangles, barycentrics


def corner_colour(part: Part, radiance: F32, vertices: NDArray[np.int_], wo_world: F32) -> F32:
    """Return phi' . radiance (n, 3) at vertices (n,) of the part, each in its own frame."""
    if part.view_texture is None or part.frames is None:
        return np.asarray(radiance[vertices, 0])
    wo_local = np.einsum("nij,nj->ni", part.frames[vertices], wo_world)
    phi = lookup(part.view_texture, hemi_octahedral(wo_local))
    phi = np.broadcast_to(phi, (*phi.shape[:2], 3))
    return np.asarray(np.einsum("nrc,nrc->nc", phi, radiance[vertices]))


def _seen_from_front(
    asset: Asset, triangles: I32, wo_world: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Whether the eye is on the side that the triangle's vertex normals point to."""
    corners = asset.faces[triangles]
    a, b, c = (asset.positions[corners[:, i]].astype(np.float64) for i in range(3))
    normal = np.cross(b - a, c - a)
    shading = asset.normals[corners].sum(axis=1)
    outward = np.einsum("ni,ni->n", normal, shading) >= 0
    towards_eye = np.einsum("ni,ni->n", normal, wo_world) >= 0
    return np.asarray(outward == towards_eye)


def _albedo(asset: Asset, part: Part, corners: I32, weights: F32) -> F32:
    albedo = part.albedo[None]
    if part.albedo_texture is not None and asset.uv is not None:
        uv = np.einsum("nc,nci->ni", weights, asset.uv[corners])
        albedo = albedo * lookup_repeating(part.albedo_texture, uv)
    if part.vertex_colours is not None:
        own = part.vertex_colours[corners - part.vertex_range[0]]
        albedo = albedo * np.einsum("nc,nck->nk", weights, own)
    return albedo
