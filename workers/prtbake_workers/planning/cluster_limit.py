"""How large the clusters of light that scatters inside may look: as the tolerance lets them.

Rows of fewer clusters are built and multiplied sooner.  What they err by depends on the medium: on
how far apart the vertices are for its mean free path, and on how fast light changes over it.  So it
is measured, at a few points, from coarse clusters to fine ones.
"""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.subsurface import SubsurfaceOperator
from prtbake_workers.transport.triangle_octree import TriangleOctree

SOLID_ANGLES = tuple(2.0 ** (1.0 - 0.5 * step) for step in range(11))
"""Tried one after the other, in steradians; at pi a triangle would stand for itself at a corner."""

FINEST = 0.02
"""What they are held against: its error is a tenth of the last of them, or less."""

CLUSTER_SHARE = 0.1
"""Of the tolerance that clusters may take up; rays of bounces may take up half of theirs."""

PROBED_POINTS = 32


@dataclass(frozen=True)
class ClusterLimit:
    """A limit, the squared-error ratio that it was measured to cost, and what rows it makes.

    ``entries`` are those of a row, clusters and vertices.
    """

    solid_angle: float
    error: float
    entries: float


def cluster_note(name: str, limit: ClusterLimit, tolerance: float) -> str | None:
    """Say of a part that even the smallest clusters err by more than their share; None if not."""
    if limit.error <= CLUSTER_SHARE * tolerance:
        return None
    return (
        f"{name}: the smallest clusters, of {limit.solid_angle:.2g} sr, are measured to err by "
        f"{limit.error:.1e} of the light that scatters inside, more than a tenth of the tolerance "
        f"{tolerance:.1e}"
    )


def choose_solid_angle(
    scene: Scene,
    dipole: Dipole,
    transfer: Float32[F32, "verts coeffs"],
    points: Float64[F64, "points 3"],
    *,
    tolerance: float,
    tree: TriangleOctree | None = None,
) -> ClusterLimit:
    """Take the largest of `SOLID_ANGLES` whose error is at most `CLUSTER_SHARE` of the tolerance.

    Parameters
    ----------
    scene
        The part alone.
    dipole
        Of its medium.
    transfer
        Diffuse transfer of its vertices.  Where it is noisy the error is too large rather than too
        small, since what is even in a cluster is all that a cluster holds.
    points
        Of the surface, the first `PROBED_POINTS` of which are probed.
    tolerance
        Squared-error ratio.
    tree
        Of the part, where it is built already.

    Returns
    -------
    ClusterLimit
        The smallest of the angles where none keeps the tolerance.
    """
    chosen = points[:PROBED_POINTS]
    finest = SubsurfaceOperator(scene, dipole, max_solid_angle=FINEST, tree=tree)
    sources = finest.sources(transfer)
    expected = _scattered(finest, chosen, sources)[0]
    energy = sum(float(np.vdot(one, one)) for one in expected)
    for angle in SOLID_ANGLES:
        operator = SubsurfaceOperator(scene, dipole, max_solid_angle=angle, tree=finest.tree)
        found, n_entries = _scattered(operator, chosen, sources)
        wrong = sum(
            float(np.vdot(ours - theirs, ours - theirs))
            for ours, theirs in zip(found, expected, strict=True)
        )
        limit = ClusterLimit(angle, wrong / energy if energy else 0.0, n_entries / len(chosen))
        if limit.error <= CLUSTER_SHARE * tolerance:
            break
    return limit


def _scattered(
    operator: SubsurfaceOperator, points: Float64[F64, "points 3"], sources: F32
) -> tuple[list[F64], int]:
    """Give what leaves points, a channel each, and the entries of their rows."""
    matrices = operator.block_at(points).matrices
    return [(one @ sources).astype(np.float64) for one in matrices], matrices[0].nnz
