"""Several meshes as one: what a bake sees."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from prtbake_storage.decode.asset import Role
from prtbake_storage.decode.sides import opposite_faces
from prtbake_workers.arrays import F64, I32, I64, Float64, Int32, Int64
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.ray_offset import (
    INSET,
    inset_boundary,
    ray_epsilon,
    ray_sides,
    same_vertices,
)


def bodies_of(roles: Sequence[Role]) -> tuple[int, ...]:
    """Say which parts are one surface: those of the object are, a receiver is one by itself."""
    return tuple(0 if role == "object" else 1 + part for part, role in enumerate(roles))


@dataclass(frozen=True, eq=False)
class Scene:
    """All parts in one set of arrays; every part shadows every other.

    Attributes
    ----------
    positions, normals, faces
        As in `Mesh`, part after part.
    frames
        Rows tangent, bitangent, normal of each vertex.
    areas
        A third of the area of the triangles around each vertex.
    uv
        Texture coordinates, NaN for the vertices of a part without any; None if none has.
    part_ranges
        First and one past the last vertex of each part.
    part_of_face
        Part of each triangle.
    bodies
        Body of each part.  Parts of one body are a surface that was cut: where they meet is neither
        an edge nor a crease.  None where every part is a body.
    two_sided
        Parts whose second half is their first turned over, see `both_sides`.  None where all have
        one side.
    """

    positions: Float64[F64, "verts 3"]
    faces: Int32[I32, "tris 3"]
    normals: Float64[F64, "verts 3"]
    frames: Float64[F64, "verts 3 3"]
    areas: Float64[F64, " verts"]
    uv: Float64[F64, "verts 2"] | None
    part_ranges: tuple[tuple[int, int], ...]
    part_of_face: Int32[I32, " tris"]
    bodies: tuple[int, ...] | None = None
    two_sided: tuple[bool, ...] | None = None

    @classmethod
    def from_parts(
        cls,
        parts: Sequence[Mesh],
        frame_seed: int | None = None,
        frames: Sequence[Float64[F64, "_ 3 3"] | None] | None = None,
        bodies: tuple[int, ...] | None = None,
        two_sided: tuple[bool, ...] | None = None,
    ) -> "Scene":
        """Join meshes.

        Parameters
        ----------
        frame_seed
            Turns the tangent frames at random, see `tangent_frames`.
        frames
            For each part the frames that its BRDF is read in, which nothing turns; None where any
            will do.
        bodies, two_sided
            Of the parts, see the attributes.
        """
        if not parts:
            raise ValueError("a scene needs at least one part")
        stops = np.cumsum([part.n_vertices for part in parts])
        ranges = tuple(
            (int(stop) - part.n_vertices, int(stop))
            for part, stop in zip(parts, stops, strict=True)
        )
        normals = np.concatenate([part.normals for part in parts])
        joined = tangent_frames(normals, seed=frame_seed)
        for (start, stop), own in zip(ranges, frames or (), strict=frames is not None):
            if own is not None:
                joined[start:stop] = own
        uv = None
        if any(part.uv is not None for part in parts):
            uv = np.concatenate(
                [np.full((p.n_vertices, 2), np.nan) if p.uv is None else p.uv for p in parts]
            )
        return cls(
            positions=np.concatenate([part.positions for part in parts]),
            faces=np.concatenate(
                [part.faces + start for part, (start, _) in zip(parts, ranges, strict=True)]
            ).astype(np.int32),
            normals=normals,
            frames=joined,
            areas=np.concatenate([part.vertex_areas for part in parts]),
            uv=uv,
            part_ranges=ranges,
            part_of_face=np.repeat(
                np.arange(len(parts), dtype=np.int32), [part.n_faces for part in parts]
            ),
            bodies=bodies,
            two_sided=two_sided,
        )

    def part(self, index: int) -> "Scene":
        """Give one part as a scene of its own: what is left when all others are taken away."""
        start, stop = self.part_ranges[index]
        own = self.part_of_face == index
        return Scene(
            positions=self.positions[start:stop],
            faces=(self.faces[own] - start).astype(np.int32),
            normals=self.normals[start:stop],
            frames=self.frames[start:stop],
            areas=self.areas[start:stop],
            uv=None if self.uv is None else self.uv[start:stop],
            part_ranges=((0, stop - start),),
            part_of_face=np.zeros(int(own.sum()), np.int32),
            two_sided=None if self.two_sided is None else (self.two_sided[index],),
        )

    @cached_property
    def bounds(self) -> Float64[F64, "2 3"]:
        """Lower and upper corner of the bounding box."""
        return np.stack([self.positions.min(axis=0), self.positions.max(axis=0)])

    @cached_property
    def ray_points(self) -> Float64[F64, "verts 3"]:
        """Where the rays of each vertex start, before the offset along its normal."""
        distance = INSET * ray_epsilon(self.bounds)
        return inset_boundary(
            self.positions, self.faces, self.normals, self._body_of_vertex, distance
        )

    @cached_property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    @cached_property
    def ray_sides(self) -> Float64[F64, "verts 3"]:
        """Direction in which rays leave each vertex: its normal, or between those of a split."""
        return ray_sides(self.positions, self.faces, self.normals, self._body_of_vertex)

    @cached_property
    def twins(self) -> Int64[I64, " verts"]:
        """First vertex of the same body with the same position and normal: mostly itself.

        The vertices that a border of parts, or a seam of texture coordinates, makes of one.
        """
        twin, first = same_vertices(self.positions, self.normals, self._body_of_vertex)
        return first[twin]

    @cached_property
    def opposite(self) -> Int64[I64, " tris"] | None:
        """The other side's copy of each triangle, -1 for none; None where all have one side."""
        if self.two_sided is None or not any(self.two_sided):
            return None
        return opposite_faces(self.faces, self.part_ranges, self.two_sided)

    @cached_property
    def traced(self) -> Int64[I64, " traced"] | None:
        """The triangles that rays are traced against, one of two copies; None for all."""
        if self.opposite is None:
            return None
        return np.flatnonzero((self.opposite < 0) | (self.opposite > np.arange(self.n_faces)))

    @property
    def traced_faces(self) -> Int32[I32, "traced 3"]:
        """Corners of those that `traced` names: what an accelerator is made of."""
        return self.faces if self.traced is None else self.faces[self.traced]

    @property
    def _body_of_vertex(self) -> Int64[I64, " verts"]:
        sizes = [stop - start for start, stop in self.part_ranges]
        bodies = range(len(sizes)) if self.bodies is None else self.bodies
        body = np.repeat(np.array(bodies, np.int64), sizes)
        # the other side of a body is a surface by itself: the rim of a sheet stays an open edge
        beyond = int(body.max()) + 1
        for (start, stop), both in zip(self.part_ranges, self.two_sided or (), strict=False):
            if both:
                body[(start + stop) // 2 : stop] += beyond
        return body

    @property
    def n_vertices(self) -> int:
        """Number of vertices of all parts."""
        return len(self.positions)

    @property
    def n_faces(self) -> int:
        """Number of triangles of all parts."""
        return len(self.faces)
