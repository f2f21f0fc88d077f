"""Direct light transport of a block of vertices, projected on an orthonormal basis."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from threading import local as thread_local
from time import perf_counter

import numpy as np
from threadpoolctl import threadpool_limits

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, I64, Float32, Float64
from prtbake_workers.basis.projection import LeastSquaresProjection
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.ray_offset import offset_origins, ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.directions import CubeDirections
from prtbake_workers.transport.left_side import (
    Sampling,
    Workspace,
    local_directions,
    unfold_pairs,
    visible_share,
    weighted_transport,
)
from prtbake_workers.transport.mirrored import Product, product_of
from prtbake_workers.transport.plain_product import PickedDirections
from prtbake_workers.transport.projection import VertexGroup, plan_projection
from prtbake_workers.transport.visibility import padded_directions

CHUNK_BYTES = 48 << 20
"""Samples of all terms held by one thread."""

CANCELLATION_LIMIT = 1e-6
"""Share of a vertex's energy below which its residual is rounding (about 1e-7) in good part and
is summed from the differences instead."""

STAGES = ("visibility", "left_side", "product", "residual")


@dataclass(frozen=True)
class BakedBlock:
    """Transport of consecutive vertices.

    Attributes
    ----------
    coefficients
        Coefficients of every term.
    signal_energy, residual_energy
        Squared radiance norm of the transport of each vertex, and of what the projection lost of
        it: over the sphere of incident light and, phi being orthonormal, over cosine-weighted
        outgoing directions.  Not yet weighted with the vertices' areas.
    n_rays
        Shadow rays traced.
    n_culled
        Directions below the vertices' horizons: rays saved, supersamples not counted.
    n_without_normal
        Vertices with no usable normal; their transport is zero.
    n_direct_residuals
        Vertices whose residual was summed from the differences.
    dense_share
        Samples multiplied by the projection over those of the dense product.
    epsilon
        Offset of the ray origins in scene units.
    seconds
        Time in each of `STAGES`, summed over the threads.
    """

    coefficients: Float32[F32, "verts terms coeffs"]
    signal_energy: Float64[F64, " verts"]
    residual_energy: Float64[F64, " verts"]
    n_rays: int
    n_culled: int
    n_without_normal: int
    n_direct_residuals: int
    dense_share: float
    epsilon: float
    seconds: dict[str, float]

    def counters(self) -> dict[str, int | float]:
        """Give what a report adds up over blocks."""
        return {
            "rays": self.n_rays,
            "culled_directions": self.n_culled,
            "vertices_without_normal": self.n_without_normal,
            "direct_residuals": self.n_direct_residuals,
        }


@dataclass(frozen=True)
class _Chunk:
    vertices: I64
    signal_energy: F64
    residual_energy: F64
    n_rays: int
    n_culled: int
    n_direct: int
    seconds: tuple[float, ...]


def bake_block(
    scene: Scene,
    accelerator: Accelerator | None,
    vertex_range: tuple[int, int],
    *,
    factorisation: Factorisation,
    projection: LeastSquaresProjection,
    directions: CubeDirections,
    product: Product | None = None,
    supersample: int = 1,
    shadows: bool = True,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> BakedBlock:
    """Bake ``T_k(w) = psi_k(w_local) V(w) max(0, n . w)`` for a block of vertices.

    [Tsai2006]_ eq. (9) at the texel centres of a cube map, projected on the basis.

    Parameters
    ----------
    scene
        All parts; those in the accelerator cast shadows.
    accelerator
        The occluders; None if there are none.
    vertex_range
        First and one past the last vertex, of one part.
    factorisation
        The part's BRDF.
    projection
        Of the basis at ``directions``, see `IncidentBasis.projection`.
    directions
        Where transport is sampled.
    product
        `product_of` projection and directions; None makes it, which every tile would pay for.
    supersample
        S: V is the share of S x S rays that escape.
    shadows
        False takes V = 1 and traces nothing, as does an accelerator of None.
    threads
        Chunks worked on at a time; the result does not depend on it.
    progress
        Called with vertices done and in all, from this thread; what it raises ends the bake.

    Returns
    -------
    BakedBlock
        The same bytes for the same arguments: BLAS runs on one thread inside.

    Raises
    ------
    SettingsError
        A range outside the scene, or a projection made for other directions.

    Notes
    -----
    Memory: the coefficients (4 bytes x terms x coeffs a vertex), the projection matrices and
    about 80 MB a thread.
    """
    start, stop = vertex_range
    if not 0 <= start <= stop <= scene.n_vertices:
        raise SettingsError(
            f"vertex range {start}..{stop} is outside the scene's {scene.n_vertices}"
        )
    if len(projection.samples) != directions.n:
        raise SettingsError(
            f"the projection is for {len(projection.samples)} directions, not {directions.n}"
        )
    n_verts, n_terms = stop - start, factorisation.n_terms
    plan = plan_projection(scene.normals[start:stop], directions.directions, n_terms)
    if product is None:
        product = product_of(projection, directions.directions)
    coefficients = np.zeros((n_verts, n_terms, projection.n_coeffs), np.float32)
    epsilon = ray_epsilon(scene.bounds)
    baker = _Baker(
        accelerator=accelerator if shadows else None,
        origins=offset_origins(scene.ray_points[start:stop], scene.ray_sides[start:stop], epsilon),
        frames=scene.frames[start:stop],
        factorisation=factorisation,
        projection=projection,
        product=product,
        sampling=Sampling.of(
            directions.directions,
            padded_directions(directions.sub_directions(supersample)),
            projection.weights,
        ),
        coefficients=coefficients,
    )
    signal, residual = np.zeros(n_verts), np.zeros(n_verts)
    n_rays = n_culled = n_direct = done = 0
    seconds = np.zeros(len(STAGES))
    chunks = plan.chunks(CHUNK_BYTES // (4 * n_terms))
    with threadpool_limits(limits=1, user_api="blas"):
        for chunk in _in_threads(baker.bake, chunks, threads):
            signal[chunk.vertices] = chunk.signal_energy
            residual[chunk.vertices] = chunk.residual_energy
            n_rays += chunk.n_rays
            n_culled += chunk.n_culled
            n_direct += chunk.n_direct
            seconds += chunk.seconds
            done += len(chunk.vertices)
            if progress is not None:
                progress(done, n_verts)
    return BakedBlock(
        coefficients=coefficients,
        signal_energy=signal,
        residual_energy=residual,
        n_rays=n_rays,
        n_culled=n_culled,
        n_without_normal=n_verts - done,
        n_direct_residuals=n_direct,
        dense_share=plan.dense_share,
        epsilon=epsilon,
        seconds=dict(zip(STAGES, seconds.tolist(), strict=True)),
    )


class _Baker:
    """Bakes one chunk of a group at a time; each thread keeps its own buffers."""

    def __init__(
        self,
        *,
        accelerator: Accelerator | None,
        origins: Float32[F32, "verts 3"],
        frames: Float64[F64, "verts 3 3"],
        factorisation: Factorisation,
        projection: LeastSquaresProjection,
        product: Product,
        sampling: Sampling,
        coefficients: Float32[F32, "verts terms coeffs"],
    ) -> None:
        self.accelerator = accelerator
        self.origins = origins
        self.frames = frames
        self.factorisation = factorisation
        self.projection = projection
        self.product = product
        self.sampling = sampling
        self.coefficients = coefficients
        self.own = thread_local()

    def bake(self, group: VertexGroup) -> _Chunk:
        """Bake the vertices of a group: its rows of the coefficients, which no other writes."""
        work, sampling, picked = self._workspace(group)
        vertices = group.vertices
        frames = self.frames[vertices]
        clock = [perf_counter()]
        local = local_directions(frames, sampling, work)
        share, n_rays = visible_share(
            self.accelerator,
            self.origins[vertices],
            frames[:, 2].astype(np.float32),
            local[2],
            sampling,
            work,
        )
        n_culled = len(vertices) * self.projection.samples.shape[0]
        n_culled -= int(np.count_nonzero(local[2] > 0.0))
        clock.append(perf_counter())
        terms, signal = weighted_transport(self.factorisation, local, share, sampling, work)
        clock.append(perf_counter())
        projected = self.product.multiply(terms, picked, work)
        clock.append(perf_counter())
        explained = self.product.unfold(projected, self.coefficients, vertices, work)
        residual = np.maximum(signal - explained, 0.0)
        small = np.flatnonzero((residual < CANCELLATION_LIMIT * signal) & (signal > 0.0))
        for vertex in small:
            residual[vertex] = self._direct(
                terms[:, vertex], int(vertices[vertex]), sampling, picked.directions
            )
        clock.append(perf_counter())
        return _Chunk(
            vertices, signal, residual, n_rays, n_culled, len(small),
            tuple(np.diff(clock)),
        )  # fmt: skip

    def _workspace(self, group: VertexGroup) -> tuple[Workspace, Sampling, PickedDirections]:
        """Buffers of this thread and the group's directions, kept while the group stays."""
        own = self.own
        if not hasattr(own, "work"):
            own.work, own.directions = Workspace(), None
        if own.directions is not group.directions:
            own.directions, own.picked = group.directions, self.product.pick(group.directions)
            own.sampling = self.sampling.pick(own.picked.directions, own.picked.n_pairs)
        return own.work, own.sampling, own.picked

    def _direct(self, weighted: F32, vertex: int, sampling: Sampling, directions: I64) -> float:
        unfolded = weighted.copy()
        unfold_pairs(unfolded, sampling.n_pairs)
        samples = np.zeros((1, len(weighted), self.projection.samples.shape[0]))
        samples[0, :, directions] = (unfolded / sampling.root_weights).T
        own = self.coefficients[vertex][None]
        return float(self.projection.residual_energy_direct(samples, own)[0])


def _in_threads(
    work: Callable[[VertexGroup], _Chunk], items: Iterator[VertexGroup], threads: int
) -> Iterator[_Chunk]:
    """Map in order, with at most two items a thread under way."""
    if threads == 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        pending = [pool.submit(work, item) for item in islice(items, 2 * threads)]
        try:
            while pending:
                yield pending.pop(0).result()
                pending += [pool.submit(work, item) for item in islice(items, 1)]
        finally:
            for future in pending:
                future.cancel()
