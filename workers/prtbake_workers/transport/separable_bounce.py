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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from scipy.sparse import coo_array

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.ray_offset import offset_origins
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.hemisphere_rays import cosine_directions, lattice, shifted, shifts
from prtbake_workers.transport.surface import OpaqueSurface, above_horizon

COEFFS_PER_PRODUCT = 64
"""Coefficients carried at a time: they do not mix, and a block of all vertices stays small."""


@runtime_checkable
class Sent(Protocol):
    """Transfer of all vertices of one part, read a block of coefficients at a time."""

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Vertices, terms, channels, coefficients."""
        ...

    def columns(self, start: int, stop: int) -> Float32[F32, "verts terms channels block"]:
        """Return the coefficients start..stop."""
        ...


@dataclass(frozen=True)
class SentArray:
    """Transfer that lies in memory."""

    transfer: Float32[F32, "verts terms channels coeffs"]

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Vertices, terms, channels, coefficients."""
        verts, terms, channels, coeffs = self.transfer.shape
        return verts, terms, channels, coeffs

    def columns(self, start: int, stop: int) -> Float32[F32, "verts terms channels block"]:
        """Return the coefficients start..stop."""
        return np.ascontiguousarray(self.transfer[..., start:stop])


@dataclass(frozen=True)
class GatheredBounce:
    """What one bounce brings to a block of vertices.

    Attributes
    ----------
    transfer
        Whitened coefficients; its channels are those of what was sent.
    n_rays, n_hits, n_back_hits
        Rays traced, those that hit anything, those of them that met a back, which sends nothing.
    """

    transfer: Float32[F32, "verts terms channels coeffs"]
    n_rays: int
    n_hits: int
    n_back_hits: int

    def counters(self) -> dict[str, int]:
        """Give what a report adds up over blocks."""
        return {
            "bounce_rays": self.n_rays,
            "bounce_hits": self.n_hits,
            "bounce_back_hits": self.n_back_hits,
        }


def gather_bounce(
    scene: Scene,
    accelerator: Accelerator,
    part: int,
    vertex_range: tuple[int, int],
    *,
    factorisations: Sequence[Factorisation],
    albedo: Albedo,
    sent: Sequence[Sent],
    n_rays: int,
    seed: int,
) -> GatheredBounce:
    """Gather what all parts send to a block of vertices.

    Parameters
    ----------
    scene, accelerator
        All parts, and all of their triangles in order; surfaces have one side.
    part, vertex_range
        The part that receives, and first and one past the last of its vertices, in scene numbering.
    factorisations, sent
        BRDF and transfer of each part; transfers have one channel, or three, all alike.
    albedo
        What multiplies the radiance that each point of the surface sends; 1 where the BRDF's
        phi holds everything.  Its channels must be those of what is sent.
    n_rays
        N rays a vertex, the same in every bounce.
    seed
        Of the shift of every vertex's rays, whatever the block.

    Returns
    -------
    GatheredBounce
        Vertices without a usable normal receive nothing.

    Raises
    ------
    SettingsError
        A range outside the part, no rays, or channels that do not fit.

    Notes
    -----
    Memory: the rays of the block with the corners' phi (12 bytes x 3 terms a hit), and
    `COEFFS_PER_PRODUCT` coefficients of all vertices.
    """
    start, stop = vertex_range
    first, last = scene.part_ranges[part]
    if not first <= start <= stop <= last:
        raise SettingsError(f"vertex range {start}..{stop} is outside part {part}: {first}..{last}")
    if n_rays < 1:
        raise SettingsError(f"n_rays must be at least 1, not {n_rays}")
    _, _, n_channels, n_coeffs = sent[0].shape
    if any(one.shape[2:] != (n_channels, n_coeffs) for one in sent):
        raise SettingsError(f"parts send other channels or coefficients: {[s.shape for s in sent]}")
    if n_channels not in (1, albedo.n_channels):
        raise SettingsError(f"{n_channels} channels are sent, the albedo has {albedo.n_channels}")
    own = factorisations[part]
    n_verts = stop - start
    result = np.zeros((n_verts, own.n_terms, n_channels, n_coeffs), np.float32)
    normals = scene.normals[start:stop]
    usable = np.flatnonzero(np.abs(np.linalg.norm(normals, axis=1) - 1.0) < 1e-3)
    if albedo.is_black or not len(usable):
        return GatheredBounce(result, 0, 0, 0)
    local = cosine_directions(shifted(lattice(n_rays), shifts(seed, start, stop, 2)[usable]))
    world = (local @ scene.frames[start + usable]).astype(np.float32)
    rays = _cast(scene, accelerator, start + usable, world)
    psi = own.eval_psi(local.reshape(-1, 3)).reshape(len(usable), n_rays, own.n_terms)
    weighted = (np.pi / n_rays * psi).transpose(0, 2, 1).astype(np.float32)
    rows = [
        _sending_rows(scene, index, factorisations[index], albedo, rays, n_channels)
        for index in range(len(sent))
    ]
    for block in _blocks(n_coeffs):
        radiance = np.zeros(
            (n_channels, len(usable) * n_rays, block.stop - block.start), np.float32
        )
        for one, matrices in zip(sent, rows, strict=True):
            if matrices is None:
                continue
            columns = one.columns(block.start, block.stop)
            for channel, matrix in enumerate(matrices):
                flat = columns[:, :, channel].reshape(-1, columns.shape[3])
                radiance[channel] += matrix @ flat
        for channel in range(n_channels):
            arriving = radiance[channel].reshape(len(usable), n_rays, -1)
            result[usable, :, channel, block] = weighted @ arriving
    return GatheredBounce(result, rays.n_rays, rays.n_hits, rays.n_hits - len(rays.index))


@dataclass(frozen=True)
class _Rays:
    """The rays that met a front: their number in the block, and what they met."""

    index: Int64[I64, " hits"]
    triangles: Int64[I64, " hits"]
    barycentrics: Float64[F64, "hits 3"]
    backwards: Float64[F64, "hits 3"]
    n_rays: int
    n_hits: int


def _cast(
    scene: Scene,
    accelerator: Accelerator,
    vertices: Int64[I64, " verts"],
    directions: Float32[F32, "verts rays 3"],
) -> _Rays:
    surface = OpaqueSurface(scene, accelerator)
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
    n_channels: int,
) -> tuple[Any, ...] | None:
    """Return for each channel the matrix (rays, verts x terms) from transfer to radiance."""
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
    at = (np.repeat(rays.index[which], 3 * n_terms), columns.ravel())
    shape = (rays.n_rays, (stop - start) * n_terms)

    def channel(c: int) -> Any:
        tint = reflected[:, min(c, reflected.shape[1] - 1)]
        values = phi[..., min(c, phi.shape[3] - 1)] * (weights * tint[:, None])[:, :, None]
        return coo_array((values.astype(np.float32).ravel(), at), shape=shape).tocsr()

    return tuple(channel(c) for c in range(n_channels))


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


def _blocks(n_coeffs: int) -> Iterator[slice]:
    for start in range(0, n_coeffs, COEFFS_PER_PRODUCT):
        yield slice(start, min(start + COEFFS_PER_PRODUCT, n_coeffs))
