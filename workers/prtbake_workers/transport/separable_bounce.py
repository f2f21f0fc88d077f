"""One bounce between parts of any separable BRDF, matrix-free: rays out, coefficients back.

With T_q,j the transfer of term j at a point q, albedo left out, light that the surface itself sends
adds to term k of a vertex p

    integral over blocked w of psi_k(w) max(0, n . w) rho(q) sum_j phi_j(-w) T_q,j dw,

q the point seen along w: [Tsai2006]_ eq. (9) on both sides of the ray.  Directions drawn with
density cos / pi turn it into ``(pi / N) sum_i psi_k(w_i) L_i``; the radiance L_i that comes along a
ray, a row of coefficients, is a sparse row times the transfer at the corners of the triangle hit.
Each corner evaluates phi in its own frame, as the decoder does.  For diffuse parts this is the
product of `bounce_operator`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.ray_offset import offset_origins
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.hemisphere_rays import cosine_directions, lattice, shifted, shifts
from prtbake_workers.transport.surface import OpaqueSurface, above_horizon

VERTICES_PER_PRODUCT = 2048
"""Vertices whose rays are carried at a time: 34 MB at 64 rays and 64 coefficients."""


@dataclass(frozen=True)
class _Product:
    """The rays of a few vertices: (pi / N) psi of each, and the rows that make its radiance.

    ``rows`` counts among the gather's vertices; ``sending`` holds for every part one matrix
    (rays, verts x terms) a channel, or None where no ray meets the part.
    """

    rows: Int64[I64, " verts"]
    weighted: Float32[F32, "verts terms rays"]
    sending: tuple[tuple[Any, ...] | None, ...]


class BounceGather:
    """One bounce to some vertices of a part: rays cast once, for any coefficients and bounce.

    Parameters
    ----------
    surface
        All parts; those with two sides have a copy of every triangle for each.
    part, vertices
        The part that receives, and which of its vertices, in scene numbering.
    factorisations
        BRDF of each part.
    albedo
        What multiplies the radiance that each point of the surface sends; 1 where the BRDF's
        phi holds everything.
    n_channels
        Of the transfer: 1, or 3 where surfaces are coloured.
    n_rays
        N rays a vertex, the same in every bounce.
    seed
        Of the shift of every vertex's rays, whichever vertices are asked for beside it; vertices
        that are `Scene.twins` have the same.

    Attributes
    ----------
    n_rays, n_hits, n_back_hits
        Rays traced, those that hit anything, those of them that met a back, which sends nothing.

    Raises
    ------
    SettingsError
        Vertices outside the part, no rays, or one channel for coloured surfaces.

    Notes
    -----
    Memory: for every vertex that sees a surface 4 bytes x terms a ray, and 8 bytes x 3 terms a hit
    and channel.
    """

    def __init__(
        self,
        surface: OpaqueSurface,
        part: int,
        vertices: Int64[I64, " verts"],
        *,
        factorisations: Sequence[Factorisation],
        albedo: Albedo,
        n_channels: int,
        n_rays: int,
        seed: int,
    ) -> None:
        scene = surface.scene
        first, last = scene.part_ranges[part]
        outside = vertices[(vertices < first) | (vertices >= last)]
        if len(outside):
            raise SettingsError(f"vertex {outside[0]} is outside part {part}: {first}..{last}")
        if n_rays < 1:
            raise SettingsError(f"n_rays must be at least 1, not {n_rays}")
        needed = max(albedo.n_channels, *(own.n_channels for own in factorisations))
        if n_channels not in (1, 3) or n_channels < needed:
            raise SettingsError(f"surfaces have {needed} channels, the transfer has {n_channels}")
        self.n_vertices, self.n_channels = len(vertices), n_channels
        self.n_terms = factorisations[part].n_terms
        self.n_rays = self.n_hits = self.n_back_hits = 0
        self._products: list[_Product] = []
        if albedo.is_black:
            return
        # a vertex that a border of parts made two of looks the same way in both
        shift, pattern = shifts(seed, 0, scene.n_vertices, 2)[scene.twins], lattice(n_rays)
        lengths = np.linalg.norm(scene.normals[vertices], axis=1)
        usable = np.flatnonzero(np.abs(lengths - 1.0) < 1e-3)
        for start in range(0, len(usable), VERTICES_PER_PRODUCT):
            rows = usable[start : start + VERTICES_PER_PRODUCT]
            own = vertices[rows]
            # in frames of the normals alone: turning those of the terms turns no ray
            drawn = cosine_directions(shifted(pattern, shift[own]))
            world = drawn @ tangent_frames(scene.normals[own])
            rays = _cast(surface, own, world)
            self.n_rays += rays.n_rays
            self.n_hits += rays.n_hits
            self.n_back_hits += rays.n_hits - len(rays.index)
            # a vertex that sees nothing but the sky needs no product
            seeing, place = np.unique(rays.index // n_rays, return_inverse=True)
            if len(seeing) == 0:
                continue
            index = place * n_rays + rays.index % n_rays
            local = np.einsum("vij,vrj->vri", scene.frames[own[seeing]], world[seeing])
            psi = factorisations[part].eval_psi(local.reshape(-1, 3))
            psi = psi.reshape(len(seeing), n_rays, -1).transpose(0, 2, 1)
            shape = (len(seeing) * n_rays, n_channels)
            self._products.append(
                _Product(
                    rows=rows[seeing],
                    weighted=np.ascontiguousarray(np.pi / n_rays * psi, np.float32),
                    sending=tuple(
                        _sending_rows(scene, number, sender, albedo, rays, index, shape)
                        for number, sender in enumerate(factorisations)
                    ),
                )
            )

    def apply(
        self, sent: Sequence[Float32[F32, "_ channels _ coeffs"]]
    ) -> Float32[F32, "verts channels terms coeffs"]:
        """Gather what all parts send: one array a part, of all of its vertices and terms.

        Returns
        -------
        ndarray
            Vertices without a usable normal receive nothing.

        Raises
        ------
        SettingsError
            A part sends other channels or coefficients than the first, or than was said.
        """
        n_coeffs = sent[0].shape[3]
        if any(one.shape[1] != self.n_channels or one.shape[3] != n_coeffs for one in sent):
            raise SettingsError(
                f"{self.n_channels} channels are expected alike from every part, not "
                f"{[one.shape for one in sent]}"
            )
        shape = (self.n_vertices, self.n_channels, self.n_terms, n_coeffs)
        result = np.zeros(shape, np.float32)
        for channel in range(self.n_channels):
            flat = [one[:, channel].reshape(-1, n_coeffs) for one in sent]
            for product in self._products:
                n_verts, _, n_rays = product.weighted.shape
                radiance = np.zeros((n_verts * n_rays, n_coeffs), np.float32)
                for matrices, one in zip(product.sending, flat, strict=True):
                    if matrices is not None:
                        radiance += matrices[channel] @ one
                # no name for what arrives: it would be held while the next product is made
                result[product.rows, channel] = product.weighted @ radiance.reshape(
                    n_verts, n_rays, n_coeffs
                )
        return result

    def counters(self) -> dict[str, int]:
        """Give what a report adds up over tasks."""
        return {
            "bounce_rays": self.n_rays,
            "bounce_hits": self.n_hits,
            "bounce_back_hits": self.n_back_hits,
        }


@dataclass(frozen=True)
class _Rays:
    """The rays that met a front: their number among all, and what they met."""

    index: Int64[I64, " hits"]
    triangles: Int64[I64, " hits"]
    barycentrics: Float64[F64, "hits 3"]
    backwards: Float64[F64, "hits 3"]
    n_rays: int
    n_hits: int


def _cast(
    surface: OpaqueSurface, vertices: Int64[I64, " verts"], world: Float64[F64, "verts rays 3"]
) -> _Rays:
    scene, directions = surface.scene, world.astype(np.float32)
    origins = offset_origins(scene.ray_points[vertices], scene.ray_sides[vertices], surface.epsilon)
    flat = np.ascontiguousarray(directions.reshape(-1, 3))
    hits = surface.intersect(np.repeat(origins, directions.shape[1], axis=0), flat)
    index = hits.rays[hits.front]
    return _Rays(
        index=index,
        triangles=hits.triangles[hits.front],
        barycentrics=hits.barycentrics[hits.front],
        backwards=-flat[index].astype(np.float64),
        n_rays=len(flat),
        n_hits=len(hits.rays),
    )


def _sending_rows(
    scene: Scene,
    part: int,
    factorisation: Factorisation,
    albedo: Albedo,
    rays: _Rays,
    index: Int64[I64, " hits"],
    shape: tuple[int, int],
) -> tuple[Any, ...] | None:
    """Return for each channel the matrix (rays, verts x terms) from transfer to radiance.

    ``index`` numbers the hits' rays among those kept; ``shape`` counts these and the channels.
    """
    which = np.flatnonzero(scene.part_of_face[rays.triangles] == part)
    if not len(which):
        return None
    start, stop = scene.part_ranges[part]
    triangles, weights = rays.triangles[which], rays.barycentrics[which]
    corners = scene.faces[triangles].astype(np.int64)
    phi = _corner_phi(scene, factorisation, corners, rays.backwards[which])
    reflected = albedo.checked_at(triangles, weights)
    n_terms = factorisation.n_terms
    columns = (corners - start)[:, :, None] * n_terms + np.arange(n_terms)
    at = (np.repeat(index[which], 3 * n_terms), columns.ravel())

    def channel(c: int) -> Any:
        tint = reflected[:, min(c, reflected.shape[1] - 1)]
        values = phi[..., min(c, phi.shape[3] - 1)] * (weights * tint[:, None])[:, :, None]
        matrix = coo_array(
            (values.astype(np.float32).ravel(), at), shape=(shape[0], (stop - start) * n_terms)
        )
        return matrix.tocsr()

    return tuple(channel(c) for c in range(shape[1]))


def _corner_phi(
    scene: Scene, factorisation: Factorisation, corners: I64, backwards: Float64[F64, "hits 3"]
) -> Float64[F64, "hits 3 terms channels"]:
    """Evaluate phi towards the receiver in every corner's own frame; 1 where it is albedo alone."""
    if factorisation.is_constant_phi:
        return np.ones((len(corners), 3, 1, 1))
    wo = np.repeat(backwards, 3, axis=0)
    vertices = corners.ravel()
    lifted = above_horizon(wo, scene.normals[vertices])
    towards = np.einsum("nij,nj->ni", scene.frames[vertices], lifted)
    phi = factorisation.eval_phi(towards)
    return np.asarray(phi.reshape(len(corners), 3, *phi.shape[1:]))
