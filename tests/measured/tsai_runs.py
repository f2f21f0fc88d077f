"""Bake, CTA and all-frequency CPCA at the settings of [Tsai2006] tables 1 and 2."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.quantise import INT16_MAX, finest_scale, levels, quantise
from prtbake_workers.basis.projection import explained_energy
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.compress.baselines.segmented_cpca_model import SegmentedCpcaModel
from prtbake_workers.compress.cta import CtaModel, CtaRanks, compress_cta
from prtbake_workers.compress.cta_adaptive import with_own_ranks
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.ray_offset import offset_origins, ray_epsilon
from prtbake_workers.geometry.receiver import receiver_plane
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.directions import CubeDirections, cube_directions
from prtbake_workers.transport.left_side import (
    Sampling,
    Workspace,
    local_directions,
    visible_share,
    weighted_transport,
)
from prtbake_workers.transport.mirrored import product_of
from prtbake_workers.transport.visibility import padded_directions

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

PAPER_RANKS = CtaRanks(8, 48, 24)
OWN_RANKS = CtaRanks(12, 43, 24)
"""About as many numbers as the paper's, over which clusters of own ranks divide them anew."""
TILE_VERTICES = 4096
CHUNK_VERTICES = 1024
NUMBER_BYTES = 2
"""Factors are stored in 16 bits, as [Tsai2006] stores coefficients; so are those of the baselines."""


@dataclass(frozen=True)
class Settings:
    """What all models are measured at.

    The defaults are those of the paper, but for 2 x 2 rays a texel in place of 4 x 4 samples, and
    few iterations: the fourth wins some thousandths of the error.
    """

    n_terms: int = 16
    cube_resolution: int = 32
    supersample: int = 2
    ranks: CtaRanks = PAPER_RANKS
    own_ranks: CtaRanks = OWN_RANKS
    max_iterations: int = 3
    block: int = 16
    """Texels along an edge of a segment: 24 segments of 256, as table 2 has them."""
    seed: int = 0


class Sampled:
    """An object on a plane: its transport in the directions of a cube map."""

    def __init__(self, mesh: Mesh, settings: Settings, gap: float = 0.0) -> None:
        alone = Scene.from_parts([mesh])
        plane = receiver_plane(alone.bounds, resolution=2, extent=2.0, gap=gap)
        self.scene = Scene.from_parts([mesh, plane])
        self.n_vertices = mesh.n_vertices
        self.areas: F64 = self.scene.areas[: mesh.n_vertices]
        self.settings = settings
        self.accelerator = Accelerator(self.scene.positions, self.scene.faces)
        self.cube: CubeDirections = cube_directions(settings.cube_resolution)
        brdf = CookTorrance(np.array([0.3]), np.array([0.7]), 0.5, np.array([0.1]))
        self.factorisation: Factorisation = factorise(brdf, n_terms=settings.n_terms)
        self.roots: F64 = np.sqrt(self.cube.weights)

    @property
    def raw_bytes(self) -> int:
        """Bytes of the float32 samples, which the paper calls raw data (already cut to terms)."""
        return 4 * self.n_vertices * self.factorisation.n_terms * self.cube.n

    @cached_property
    def _origins(self) -> F32:
        return offset_origins(
            self.scene.ray_points, self.scene.ray_sides, ray_epsilon(self.scene.bounds)
        )

    def draw(self, n: int, seed: int) -> I64:
        """Draw vertices by area, rising."""
        rng = np.random.default_rng(seed)
        share = self.areas / self.areas.sum()
        return np.sort(rng.choice(self.n_vertices, size=n, p=share))

    def samples(self, vertices: I64, texels: I64) -> F32:
        """Return (verts, terms, texels): transport times the root of the solid angle."""
        s = self.settings.supersample
        directions = self.cube.directions[texels]
        sampling = Sampling(
            samples=padded_directions(self.cube.sub_directions(s)[:, texels]),
            centres=np.ascontiguousarray(directions.T, dtype=np.float32),
            root_weights=self.roots[texels].astype(np.float32),
        )
        work = Workspace()
        out = np.empty((len(vertices), self.factorisation.n_terms, len(texels)), np.float32)
        for start in range(0, len(vertices), CHUNK_VERTICES):
            part = vertices[start : start + CHUNK_VERTICES]
            frames = self.scene.frames[part]
            local = local_directions(frames, sampling, work)
            share, _ = visible_share(
                self.accelerator, self._origins[part], frames[:, 2].astype(np.float32),
                local[2], sampling, work,
            )  # fmt: skip
            terms, _ = weighted_transport(self.factorisation, local, share, sampling, work)
            out[start : start + len(part)] = terms.transpose(1, 0, 2)
        return out

    def segments(self, blocks: Sequence[I64]) -> Iterator[F32]:
        """Give the samples of all vertices, a segment at a time."""
        everyone = np.arange(self.n_vertices)
        for texels in blocks:
            yield self.samples(everyone, texels)


@dataclass(frozen=True)
class Baked:
    """Coefficients of every vertex, and what the projection left of it."""

    coefficients: F32
    signal: F64
    residual: F64
    seconds: float

    def error(self, areas: F64) -> float:
        """Squared error of the projection over the squared norm of the samples."""
        return float(areas @ self.residual / (areas @ self.signal))


def bake(sampled: Sampled, basis: SrbfBasis) -> Baked:
    """Project the transport of all vertices; CPU seconds."""
    start = time.process_time()
    projection = basis.projection(sampled.cube.directions, sampled.cube.weights)
    product = product_of(projection, sampled.cube.directions)
    n = sampled.n_vertices
    coefficients = np.empty((n, sampled.factorisation.n_terms, basis.n), np.float32)
    signal, residual = np.empty(n), np.empty(n)
    for first in range(0, n, TILE_VERTICES):
        tile = slice(first, min(n, first + TILE_VERTICES))
        block = bake_block(
            sampled.scene, sampled.accelerator, (tile.start, tile.stop),
            factorisation=sampled.factorisation, projection=projection,
            directions=sampled.cube, product=product, supersample=sampled.settings.supersample,
        )  # fmt: skip
        coefficients[tile] = block.coefficients
        signal[tile], residual[tile] = block.signal_energy, block.residual_energy
    return Baked(coefficients, signal, residual, time.process_time() - start)


def projection_error(sampled: Sampled, basis: SrbfBasis, vertices: I64, samples: F32) -> float:
    """Return the squared-error ratio of the projection at vertices that were drawn by area."""
    projection = basis.projection(sampled.cube.directions, sampled.cube.weights)
    matrix = (projection.matrix / sampled.roots[:, None]).astype(np.float32)
    rows = samples.reshape(-1, sampled.cube.n)
    coefficients = (rows @ matrix).reshape(len(vertices), -1, basis.n)
    energy = np.einsum("vkd,vkd->v", samples, samples, dtype=np.float64)
    explained = explained_energy(coefficients, projection.rest.astype(np.float32))
    return float(np.maximum(energy - explained, 0.0).sum() / energy.sum())


@dataclass(frozen=True)
class Compressed:
    """CTA as it is stored in 16 bits, and what it and its rounding miss of the coefficients."""

    model: CtaModel
    errors: F64
    """Squared error of each vertex, rounding included."""
    nbytes: int
    seconds: float


def compress(sampled: Sampled, baked: Baked, n_clusters: int, *, own_ranks: bool) -> Compressed:
    """Compress all coefficients; CPU seconds of CTA alone."""
    settings = sampled.settings
    start = time.process_time()
    model = compress_cta(
        baked.coefficients, n_clusters, settings.own_ranks if own_ranks else settings.ranks,
        seed=settings.seed, max_iterations=settings.max_iterations, vertex_weights=sampled.areas,
    )  # fmt: skip
    if own_ranks:
        model = with_own_ranks(model, baked.coefficients, vertex_weights=sampled.areas)
    seconds = time.process_time() - start
    stored = in_sixteen_bits(model)
    errors = np.empty(sampled.n_vertices)
    for first in range(0, sampled.n_vertices, TILE_VERTICES):
        tile = slice(first, first + TILE_VERTICES)
        difference = baked.coefficients[tile] - stored.reconstruct(tile)
        errors[tile] = np.einsum("vkl,vkl->v", difference, difference, dtype=np.float64)
    return Compressed(stored, errors, cta_bytes(model), seconds)


def in_sixteen_bits(model: CtaModel) -> CtaModel:
    """Return the model as a reader of an asset sees it."""
    peaks = np.zeros((model.n_clusters, model.weights.shape[1]))
    np.maximum.at(peaks, model.labels, np.abs(model.weights).astype(np.float64))
    scale = finest_scale(peaks, INT16_MAX)[model.labels]
    return replace(
        model,
        light_bases=quantise(model.light_bases, (1,)).dequantised(),
        dual_bases=quantise(model.dual_bases, (2,)).dequantised(),
        weights=levels(model.weights, scale).astype(np.float32) * scale,
    )


def cta_bytes(model: CtaModel) -> int:
    """Count 16-bit factors, their scales, the view basis, and a byte a vertex for its cluster.

    Zeros beyond a cluster's ranks count nothing.
    """
    numbers = model.nbytes // 4 - model.view_basis.size
    _, light, vert = model.ranks.sum(axis=0).tolist()
    scales = light + 2 * vert
    return NUMBER_BYTES * numbers + 4 * scales + model.view_basis.nbytes + len(model.labels)


COLUMN_NUMBERS = 2 * 4 / NUMBER_BYTES
"""Two scales of a component, as many numbers as take their bytes."""


def cpca_bytes(model: SegmentedCpcaModel) -> int:
    """Count a model as `cta_bytes` does CTA: a byte a vertex and segment too."""
    total = 0 if model.view_basis is None else model.view_basis.nbytes
    for one in model.models:
        numbers = one.nbytes // 4
        scales = one.n_clusters + 2 * int(one.ranks.sum())
        labels = len(one.labels) if one.n_clusters > 1 else 0
        total += NUMBER_BYTES * numbers + 4 * scales + labels
    return total


def direct_error(
    sampled: Sampled, basis: SrbfBasis, compressed: Compressed, vertices: I64, samples: F32
) -> float:
    """Return the squared-error ratio of what is stored against samples, vertex by vertex."""
    functions = basis.reconstruction_matrix(sampled.cube.directions) * sampled.roots[:, None]
    wrong = 0.0
    for vertex, own in zip(vertices, samples, strict=True):
        stored = compressed.model.reconstruct(slice(int(vertex), int(vertex) + 1))[0]
        difference = own - stored.astype(np.float64) @ functions.T
        wrong += float(np.sum(difference**2))
    return wrong / float(np.einsum("vkd,vkd->", samples, samples, dtype=np.float64))
