"""What the projection misses in directions that it has not seen.

The residual of a least-squares fit is measured where the fit was made.  Where the directions do not
resolve the basis (fewer than about 2.5 a centre) the fit passes through its samples and swings
between them: the residual tends to nothing while the error grows.  So some vertices are sampled
again, in directions of their own.
"""

import numpy as np
from threadpoolctl import threadpool_limits

from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.basis.incident import OrthonormalFunctions
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.ray_offset import ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.reference import SurfacePoints, to_local, visible_cosine

VERTICES = 256
RESOLUTION = 8
"""Of the cube map that is turned at random: 384 directions.  Vertices differ more than directions
do."""

VERTICES_AT_ONCE = 16
"""50 kB a term, so that 64 terms stay within a few MB."""


def held_out_energies(
    scene: Scene,
    accelerator: Accelerator | None,
    vertex_range: tuple[int, int],
    coefficients: Float32[F32, "verts terms coeffs"],
    *,
    factorisation: Factorisation,
    basis: OrthonormalFunctions,
    seed: int,
) -> tuple[float, float]:
    """Estimate the squared norms of a block's transport and of what its coefficients miss of it.

    Parameters
    ----------
    scene, accelerator, vertex_range, factorisation
        As given to `bake_block`.
    coefficients
        What it returned.
    basis
        The basis that they belong to.
    seed
        Chooses vertices (by area) and the turn of the directions.

    Returns
    -------
    signal, residual
        Summed over the block, weighted with the vertices' areas; their ratio is the squared error
        of the projection, within about 10 % of itself for one block.  Visibility is that of single
        rays, whatever the bake averaged.
    """
    start, stop = vertex_range
    areas = np.maximum(scene.areas[start:stop], 0.0)
    total = float(areas.sum())
    if total == 0.0:
        return 0.0, 0.0
    rng = np.random.default_rng(seed)
    # evenly spread over the area
    at = (np.arange(VERTICES) + rng.random()) * (total / VERTICES)
    chosen = np.minimum(np.searchsorted(np.cumsum(areas), at, side="right"), stop - start - 1)
    cube = cube_directions(RESOLUTION)
    directions = cube.directions @ random_turn(rng)
    vertices = start + chosen
    received = visible_cosine(
        # where the rays of the bake start, or light would leak in at open edges and creases
        SurfacePoints(
            scene.ray_points[vertices], scene.normals[vertices], scene.ray_sides[vertices]
        ),
        directions,
        accelerator,
        ray_epsilon(scene.bounds),
    )
    signal = residual = 0.0
    # the sums are small, and the number of threads would change their last bits
    with threadpool_limits(limits=1, user_api="blas"):
        tabled = basis.reconstruction_matrix(directions).T
        for first in range(0, VERTICES, VERTICES_AT_ONCE):
            rows = slice(first, first + VERTICES_AT_ONCE)
            local = to_local(scene.frames[vertices[rows]], directions)
            psi = factorisation.eval_psi(local.reshape(-1, 3)).reshape(*local.shape[:2], -1)
            truth = psi.transpose(0, 2, 1) * received[rows, None]
            missed = truth - coefficients[chosen[rows]].astype(np.float64) @ tabled
            signal += float((truth**2 @ cube.weights).sum())
            residual += float((missed**2 @ cube.weights).sum())
    return total * signal / VERTICES, total * residual / VERTICES


def random_turn(rng: np.random.Generator) -> Float64[F64, "3 3"]:
    """Draw a rotation (or reflection: the cube does not mind) uniformly."""
    turn, upper = np.linalg.qr(rng.standard_normal((3, 3)))
    return np.asarray(turn * np.sign(np.diag(upper)))
