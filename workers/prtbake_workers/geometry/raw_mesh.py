"""What a reader hands to the repair: triangles as the file has them, and what it left out."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from prtbake_storage.errors import MeshError, TooLarge
from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.geometry.vertex_colours import RawColours


@dataclass(frozen=True)
class MeshLimits:
    """Bounds on what a file may ask for; they keep a hostile file from taking the machine.

    Four million vertices are a hundred times the paper's meshes; a bake of one term at 642
    coefficients would already take 10 GB.
    """

    vertices: int = 4_000_000
    triangles: int = 8_000_000
    polygon_corners: int = 256
    nodes: int = 100_000

    def check(self, *, vertices: int = 0, triangles: int = 0) -> None:
        """Raise TooLarge where a count exceeds its limit."""
        if vertices > self.vertices:
            raise TooLarge(f"mesh has {vertices} vertices; the limit is {self.vertices}")
        if triangles > self.triangles:
            raise TooLarge(f"mesh has {triangles} triangles; the limit is {self.triangles}")

    def check_polygon(self, n_corners: int, where: str) -> None:
        """Raise MeshError where a polygon has too many corners."""
        if n_corners > self.polygon_corners:
            raise MeshError(
                f"{where}: a face with {n_corners} corners; the limit is {self.polygon_corners}"
            )


@dataclass(frozen=True, eq=False)
class RawMesh:
    """Triangles before repair.

    Attributes
    ----------
    positions, faces
        As in the file; a vertex is split where the file gives it several texture coordinates or
        normals.
    uv
        Texture coordinates, NaN where a vertex has none; None where no vertex has any.
    vertex_labels
        The file's own number of each vertex, for messages; None where it is the index itself.
    n_polygons
        Faces in the file with more than three corners.
    n_short_faces
        Faces in the file with fewer than three corners, left out.
    warnings
        Sentences about what was left out or guessed.
    normals
        Vertex normals of any length, NaN where a vertex has none and 0 0 0 where that of the file
        is not finite; None where no vertex has any.
    colours
        Vertex colours; None where no vertex has any.
    face_groups
        Group of each triangle, an index of ``group_names``; None where the file has no groups.
    group_names
        As in the file: `settle_groups` makes them legal.
    """

    positions: Float64[F64, "verts 3"]
    faces: Int64[I64, "tris 3"]
    uv: Float64[F64, "verts 2"] | None = None
    vertex_labels: Int64[I64, " verts"] | None = None
    n_polygons: int = 0
    n_short_faces: int = 0
    warnings: list[str] = field(default_factory=list)
    normals: Float64[F64, "verts 3"] | None = None
    colours: RawColours | None = None
    face_groups: Int64[I64, " tris"] | None = None
    group_names: Sequence[str] = ()
