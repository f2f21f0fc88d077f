"""Transport: shadow rays beside bare Embree, the projection beside its dense product, the bake.

The unit of the bake is the classification product of the compression, timed between its tiles.
Two threads throughout.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from classification_unit import Shape, unit_aside
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from glossy_bunny import THREADS, bunny_scene, glossy_terms, srbf_projection
from harness import Row, best_time, in_child
from threadpoolctl import threadpool_limits

from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.ray_offset import offset_origins, ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.bake import CHUNK_BYTES, bake_block
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.left_side import (
    Sampling,
    Workspace,
    local_directions,
    visible_share,
    weighted_transport,
)
from prtbake_workers.transport.mirrored import MirroredProduct, product_of
from prtbake_workers.transport.projection import VertexGroup, plan_projection
from prtbake_workers.transport.quantise import quantise_transfer
from prtbake_workers.transport.visibility import padded_directions, visible_fraction

N_VERTICES = 34_834
UNIT = Shape(N_VERTICES, 5136, 2328)
QUICK_UNIT = Shape(N_VERTICES // 32, 5136, 2328)
LEAST_RAY_SHARE = 0.9
MOST_PRODUCT_SHARE = 0.7
MOST_BAKE_UNITS = 9.0
MOST_TILE_BYTES = 3 << 29
MOST_PROJECTION_ERROR = 0.015
SEED = 0


class Size(NamedTuple):
    n_rays_vertices: int
    n_product_vertices: int
    tile_vertices: int
    n_tiles: int | None
    """None bakes them all."""


FULL = Size(1200, 2048, 4096, None)
QUICK = Size(200, 512, 512, 1)


def rows(quick: bool) -> list[Row]:
    """Return the table of this benchmark; limits on times at full size only."""
    rays = in_child(__file__, "measure_rays", quick=quick)
    product = in_child(__file__, "measure_product", quick=quick)
    bake = in_child(__file__, "measure_bake", quick=quick)
    unit = QUICK_UNIT if quick else UNIT
    gib = 1 << 30
    table = []
    for threads in ("1", "2"):
        of = rays[threads]
        table += [
            Row(
                f"bare embreex, {threads} thread(s)",
                seconds=of["bare"],
                measured=rays["rays"] / of["bare"] / 1e6,
                unit="Mray/s",
                limit_description=f"{rays['rays']} rays in prebuilt arrays",
            ),
            Row(
                f"visibility, {threads} thread(s)",
                seconds=of["ours"],
                measured=of["bare"] / of["ours"],
                unit="of bare",
                limit=None if quick else LEAST_RAY_SHARE,
                limit_is="at least",
                limit_description="same rays and threads, masks and scatter included",
            ),
        ]
    table += [
        Row(
            "dense product",
            seconds=product["dense"],
            measured=product["gflops"],
            unit="GFlop/s",
            limit_description=f"{product['rows']} x 6144 x 642, float32",
        ),
        Row(
            "projection product",
            seconds=product["ours"],
            measured=product["ours"] / product["dense"],
            unit="of dense",
            limit=None if quick else MOST_PRODUCT_SHARE,
            limit_description=f"{100 * product['share']:.1f} % of its samples, in pairs",
        ),
        Row(
            "left side",
            seconds=product["left"],
            measured=product["left"] / product["dense"],
            unit="of dense",
            limit_description="psi V cos, its energy and sums of pairs included",
        ),
        Row(
            "coefficients and residual",
            seconds=product["unfolded"],
            measured=product["unfolded"] / product["dense"],
            unit="of dense",
        ),
        Row(
            "classification product (unit)",
            seconds=bake["unit_seconds"],
            measured=bake["unit_gflops"],
            unit="GFlop/s",
            limit_description=f"{' x '.join(map(str, unit))}, float32; a piece after every tile",
        ),
        Row(
            f"bake of {bake['vertices']} vertices",
            seconds=bake["seconds"],
            measured=(bake["set_up"] + _scaled(bake)) / bake["unit_seconds"],
            unit="units",
            limit=None if quick else MOST_BAKE_UNITS,
            limit_description="with its set-up, scaled to 34,834 vertices",
            error=bake["error"],
        ),
        Row(
            "projection error",
            measured=100.0 * bake["error"],
            unit="%",
            limit=100.0 * MOST_PROJECTION_ERROR,
            limit_description="squared radiance error, area-weighted",
            error=bake["error"],
        ),
        Row("16-bit coefficients", error=bake["quantisation"], limit_description="their own error"),
        Row(
            f"peak memory of a tile of {bake['tile']}",
            measured=bake["peak_memory_bytes"] / gib,
            unit="GiB",
            limit=MOST_TILE_BYTES / gib,
            peak_memory_bytes=bake["peak_memory_bytes"],
            limit_description="16 terms x 642, quantised too",
        ),
    ]
    return table


def measure_rays(*, quick: bool) -> dict[str, Any]:
    """Time shadow rays: bare calls on prebuilt arrays in Embree's own frame, and ours."""
    scene, cube = bunny_scene(quick), cube_directions(32)
    vertices = _spread(scene, (QUICK if quick else FULL).n_rays_vertices)
    points, normals = scene.positions[vertices], scene.normals[vertices]
    origins = offset_origins(points, normals, ray_epsilon(scene.bounds))
    normals32, directions = normals.astype(np.float32), cube.directions.astype(np.float32)
    cosines = normals32 @ directions.T
    accelerator = Accelerator(scene.positions, scene.faces)
    samples, out = padded_directions(cube.sub_directions(1)), np.empty_like(cosines)

    def ours(part: slice) -> int:
        return visible_fraction(
            accelerator, origins[part], normals32[part], cosines[part], samples, out[part]
        )

    centre, scale = scene.bounds.mean(axis=0), 1.0 / scene.diagonal
    bare_scene = EmbreeScene()
    moved = ((scene.positions - centre) * scale).astype(np.float32)
    TriangleMesh(bare_scene, moved, scene.faces)
    moved_origins = ((origins - centre) * scale).astype(np.float32)
    halves = [slice(0, len(vertices) // 2), slice(len(vertices) // 2, None)]
    prebuilt = []
    for half in halves:
        above = [directions[row > 0.0] for row in cosines[half]]
        starts = np.repeat(moved_origins[half], [len(rays) for rays in above], axis=0)
        prebuilt.append((starts, np.concatenate(above)))

    def bare(rays: tuple[np.ndarray, np.ndarray]) -> None:
        bare_scene.run(*rays, query="OCCLUDED")

    n_rays = sum(len(rays) for _, rays in prebuilt)
    result: dict[str, Any] = {"rays": n_rays}
    for threads in (1, 2):
        # alternately, so that a disturbance meets both
        times = [(_timed(bare, prebuilt, threads), _timed(ours, halves, threads)) for _ in range(4)]
        best_bare, best_ours = np.min(times, axis=0)
        result[str(threads)] = {"bare": float(best_bare), "ours": float(best_ours)}
    return result


def measure_product(*, quick: bool) -> dict[str, Any]:
    """Time the stages of one tile apart, and the dense product that the groups replace."""
    size = QUICK if quick else FULL
    scene, cube, glossy, projection = (
        bunny_scene(quick),
        cube_directions(32),
        glossy_terms(),
        srbf_projection(),
    )
    vertices = _tile(scene, size.n_product_vertices)
    normals, frames = scene.normals[vertices], scene.frames[vertices]
    rays = padded_directions(cube.sub_directions(1))
    sampling = Sampling.of(cube.directions, rays, projection.weights)
    product = product_of(projection, cube.directions)
    assert isinstance(product, MirroredProduct)
    plan = plan_projection(normals, cube.directions, glossy.n_terms)
    chunks = list(plan.chunks(CHUNK_BYTES // (4 * glossy.n_terms)))
    works, lefts, products = [Workspace() for _ in chunks], {}, {}
    coefficients = np.zeros((len(normals), glossy.n_terms, projection.n_coeffs), np.float32)

    def prepare(chunk: VertexGroup, work: Workspace) -> tuple[Any, Any, Any]:
        directions = product.pick(chunk.directions)
        picked = sampling.pick(directions.directions, directions.n_pairs)
        local = local_directions(frames[chunk.vertices], picked, work)
        share, _ = visible_share(
            None, np.empty((0, 3), np.float32), normals.astype(np.float32), local[2], picked, work
        )
        return picked, local, share

    def left(index: int) -> None:
        picked, local, share = prepared[index]
        lefts[index], _ = weighted_transport(glossy, local, share, picked, works[index])

    def multiply(indices: Sequence[int]) -> None:
        last, picked = None, None
        for index in indices:
            chunk = chunks[index]
            if chunk.directions is not last:
                picked, last = product.pick(chunk.directions), chunk.directions
            products[index] = product.multiply(lefts[index], picked, works[index])

    def unfold(index: int) -> None:
        product.unfold(products[index], coefficients, chunks[index].vertices, works[index])

    everything = range(len(chunks))
    with threadpool_limits(limits=1, user_api="blas"):
        prepared = [prepare(chunk, work) for chunk, work in zip(chunks, works, strict=True)]
        _timed(left, everything, THREADS)  # touches the pages
        prepared = [prepare(chunk, work) for chunk, work in zip(chunks, works, strict=True)]
        left_seconds = _timed(left, everything, THREADS)
        by_thread = [everything[start::THREADS] for start in range(THREADS)]
        ours = best_time(lambda: _timed(multiply, by_thread, THREADS))
        unfold_seconds = best_time(lambda: _timed(unfold, everything, THREADS))
    n_rows = len(normals) * glossy.n_terms
    for held in (lefts, products, works, prepared):
        held.clear()
    matrix = projection.matrix.astype(np.float32)
    dense_left = np.full((n_rows, cube.n), np.float32(0.01))
    dense_out = np.empty((n_rows, projection.n_coeffs), np.float32)
    dense = best_time(lambda: np.matmul(dense_left, matrix, out=dense_out))
    return {
        "rows": n_rows,
        "share": plan.dense_share,
        "dense": dense,
        "gflops": 2e-9 * n_rows * cube.n * projection.n_coeffs / dense,
        "ours": ours,
        "left": left_seconds,
        "unfolded": unfold_seconds,
    }


def measure_bake(*, quick: bool) -> dict[str, Any]:
    """Bake tile after tile, set-up and rounding to 16 bits included."""
    size = QUICK if quick else FULL
    scene = bunny_scene(quick)
    glossy = glossy_terms()
    start = time.perf_counter()
    accelerator = Accelerator(scene.positions, scene.faces)
    projection, cube = srbf_projection(), cube_directions(32)
    product = product_of(projection, cube.directions)
    set_up = time.perf_counter() - start
    sums, done, seconds = np.zeros(3), 0, 0.0
    starts = range(0, scene.n_vertices, size.tile_vertices)
    with unit_aside(QUICK_UNIT if quick else UNIT) as aside:
        for first in starts[: size.n_tiles]:
            stop = min(first + size.tile_vertices, scene.n_vertices)
            start = time.perf_counter()
            block = bake_block(
                scene, accelerator, (first, stop),
                factorisation=glossy, projection=projection, directions=cube, product=product,
                threads=THREADS,
            )  # fmt: skip
            rounded = quantise_transfer(block.coefficients, threads=THREADS)
            areas = scene.areas[first:stop]
            energies = (block.signal_energy, block.residual_energy, rounded.squared_error)
            sums += [float(areas @ energy) for energy in energies]
            seconds += time.perf_counter() - start
            done = stop
            aside.time_piece()
    return {
        "seconds": set_up + seconds,
        "set_up": set_up,
        "vertices": done,
        "tile": size.tile_vertices,
        "error": sums[1] / sums[0],
        "quantisation": sums[2] / sums[0],
        **aside.measured,
    }


def _scaled(bake: dict[str, Any]) -> float:
    """Seconds of the vertices alone, for the mesh of the limits."""
    return float((bake["seconds"] - bake["set_up"]) * N_VERTICES / bake["vertices"])


def _timed(work: Callable[[Any], object], items: Sequence[Any], threads: int) -> float:
    start = time.perf_counter()
    if threads == 1:
        for item in items:
            work(item)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(work, items))
    return time.perf_counter() - start


def _tile(scene: Scene, n_verts: int) -> slice:
    """Consecutive vertices from the middle: a tile."""
    first = max(0, (scene.n_vertices - n_verts) // 2)
    return slice(first, first + n_verts)


def _spread(scene: Scene, n_verts: int) -> np.ndarray:
    """Blocks of neighbours from all over the mesh, as tiles would meet them."""
    blocks = np.array_split(np.arange(scene.n_vertices), 10)
    return np.concatenate([block[: max(1, n_verts // 10)] for block in blocks])
