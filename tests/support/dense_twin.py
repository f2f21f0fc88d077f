"""The plain twin of the bake: every direction of every vertex, float64, one vertex at a time."""

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.basis.projection import LeastSquaresProjection
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.ray_offset import offset_origins, ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.directions import CubeDirections


def sampled_transport(
    scene: Scene,
    accelerator: Accelerator | None,
    vertex: int,
    *,
    factorisation: Factorisation,
    directions: CubeDirections,
    supersample: int = 1,
) -> Float64[F64, "terms dirs"]:
    """Sample ``T_k(w) = psi_k(w_local) V(w) max(0, n . w)`` of one vertex, [Tsai2006]_ eq. (9).

    Parameters
    ----------
    scene, accelerator, vertex
        What is lit and what blocks; None blocks nothing.
    factorisation
        psi.
    directions, supersample
        As in `bake_block`.

    Returns
    -------
    ndarray
        Samples at the texel centres.
    """
    local = directions.directions @ scene.frames[vertex].T
    cosine = np.maximum(local[:, 2], 0.0)
    visible = np.ones(directions.n)
    if accelerator is not None:
        normal = scene.normals[vertex : vertex + 1]
        point = scene.ray_points[vertex : vertex + 1]
        side = scene.ray_sides[vertex : vertex + 1]
        origin = offset_origins(point, side, ray_epsilon(scene.bounds))
        escaped, risen = np.zeros(directions.n), np.zeros(directions.n)
        for rays in directions.sub_directions(supersample):
            above = rays.astype(np.float64) @ normal[0] > 0.0
            blocked = accelerator.occluded(np.repeat(origin, directions.n, axis=0), rays)
            risen += above
            escaped += above & ~blocked
        visible = escaped / np.maximum(risen, 1.0)
    return np.asarray((factorisation.eval_psi(local) * (cosine * visible)[:, None]).T)


def bake_dense(
    scene: Scene,
    accelerator: Accelerator | None,
    vertex_range: tuple[int, int],
    *,
    factorisation: Factorisation,
    projection: LeastSquaresProjection,
    directions: CubeDirections,
    supersample: int = 1,
) -> tuple[Float64[F64, "verts terms coeffs"], Float64[F64, " verts"], Float64[F64, " verts"]]:
    """Do what `bake_block` does, slowly.

    Returns
    -------
    coefficients, signal_energy, residual_energy
        As in `BakedBlock`; the residual by reconstruction at the samples.
    """
    coefficients, signal, residual = [], [], []
    for vertex in range(*vertex_range):
        samples = sampled_transport(
            scene,
            accelerator,
            vertex,
            factorisation=factorisation,
            directions=directions,
            supersample=supersample,
        )
        fit = samples @ projection.matrix
        missed = samples - fit @ projection.samples.T
        coefficients.append(fit)
        signal.append(float((samples**2 @ projection.weights).sum()))
        residual.append(float((missed**2 @ projection.weights).sum()))
    return np.array(coefficients), np.array(signal), np.array(residual)
