"""Groups of vertices with similar normals, so that the projection skips what lies below.

Half of every vertex's samples are zero: the directions under its horizon.  Vertices whose normals
lie in one narrow cone share the list of directions that any of them can see, and the product of
samples and projection matrix runs over those alone, which a `MirroredProduct` then takes in
pairs.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.geometry.icosphere import icosphere

LEVELS = (0, 1, 2, 3)
"""Icosphere subdivisions tried for the cells of normals: 12 to 642 cells."""

PICK_COST_ROWS = 64
"""Picking one row of the projection matrix costs as much as this many rows of the product
(measured: 0.6 us against 9 ns at 642 coefficients)."""

COSINE_SLACK = 1e-6
"""Widens each horizon by more than the rounding of float32 cosines."""


@dataclass(frozen=True)
class VertexGroup:
    """Vertices (indices in the block) and the directions that any of them can see."""

    vertices: Int64[I64, " verts"]
    directions: Int64[I64, " dirs"]


@dataclass(frozen=True)
class ProjectionPlan:
    """How a block of vertices is cut into groups.

    Attributes
    ----------
    groups
        In a fixed order; vertices without a usable normal are in none.
    n_vertices, n_directions
        Size of the dense product.
    """

    groups: tuple[VertexGroup, ...]
    n_vertices: int
    n_directions: int

    @property
    def dense_share(self) -> float:
        """Samples multiplied, padding included, over those of the dense product."""
        done = sum(len(group.vertices) * len(group.directions) for group in self.groups)
        return done / max(1, self.n_vertices * self.n_directions)

    def chunks(self, max_elements: int) -> Iterator[VertexGroup]:
        """Cut the groups so that vertices x directions stays within ``max_elements``."""
        for group in self.groups:
            most = max(1, max_elements // max(1, len(group.directions)))
            n_parts = -(-len(group.vertices) // most)
            for part in np.array_split(group.vertices, n_parts):
                yield VertexGroup(part, group.directions)


def plan_projection(
    normals: Float64[F64, "verts 3"], directions: Float64[F64, "dirs 3"], n_terms: int
) -> ProjectionPlan:
    """Group the vertices of a block by their normals.

    Parameters
    ----------
    normals
        Unit normals; a vertex whose normal is zero or not finite has no hemisphere and is left
        out.
    directions
        Unit directions of the samples.
    n_terms
        Rows of the product a vertex.

    Returns
    -------
    ProjectionPlan
        Of the partitions by cells of an icosphere, the one with the least work: small cells pad
        less, large ones pick fewer rows of the projection matrix.
    """
    usable = np.flatnonzero(np.abs(np.linalg.norm(normals, axis=1) - 1.0) < 1e-3)
    plans = [_plan(normals, usable, directions, level) for level in LEVELS]
    costs = [
        sum((len(g.vertices) * n_terms + PICK_COST_ROWS) * len(g.directions) for g in plan.groups)
        for plan in plans
    ]
    return plans[int(np.argmin(costs))]


def _plan(normals: F64, usable: I64, directions: F64, level: int) -> ProjectionPlan:
    _, cell = cKDTree(icosphere(level)).query(normals[usable])
    order = np.argsort(cell, kind="stable")
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    groups = [
        _group(normals, members, directions) for members in np.split(usable[order], starts[1:])
    ]
    return ProjectionPlan(
        groups=tuple(group for group in groups if len(group.vertices)),
        n_vertices=len(normals),
        n_directions=len(directions),
    )


def _group(normals: F64, members: I64, directions: F64) -> VertexGroup:
    """Find the directions above the horizon of a cone around the members' normals."""
    axis = normals[members].sum(axis=0)
    axis /= max(float(np.linalg.norm(axis)), np.finfo(np.float64).tiny)
    # w rises above a plane whose normal is within delta of the axis only if w.axis > -sin delta
    cosine = float(np.clip((normals[members] @ axis).min(initial=1.0), 0.0, 1.0))
    lowest = -np.sqrt(1.0 - cosine**2) - COSINE_SLACK
    return VertexGroup(members, np.flatnonzero(directions @ axis > lowest))
