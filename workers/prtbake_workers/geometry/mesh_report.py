"""What was found in a mesh file and done to it."""

from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass
class MeshReport:
    """What the file held and what the repair did.

    The counts of vertices and faces are ``n_file_*`` before and ``n_*`` after.  Edges are counted
    after the repair, on positions: a UV seam or a crease is no boundary.  ``uv_seam_vertices``,
    ``normal_split_vertices`` and ``crease_vertices`` are those beyond one a position that the
    texture coordinates, the file's normals and the creases call for.  ``has_normals`` says that
    normals of the file are in use; ``replaced_normals`` of its vertices had one that could not be
    used, ``vertices_without_normal`` had none, and ``turned_normals`` had one that was turned over
    with all the faces there.  ``vertex_colours`` says that the mesh has usable ones, which
    ``colour_encoding`` of the file was read as sRGB codes or as linear; ``colour_split_vertices``
    are those beyond one a position, texture coordinate and normal that they call for.  ``groups``
    are the groups of faces that can have a material of their own: ``name`` and number of ``faces``;
    none where the file tells none.
    """

    format: str = ""
    n_file_vertices: int = 0
    n_file_triangles: int = 0
    n_polygons: int = 0
    n_vertices: int = 0
    n_faces: int = 0
    has_uv: bool = False
    has_normals: bool = False
    vertex_colours: bool = False
    colour_encoding: str | None = None
    unreferenced_vertices: int = 0
    duplicate_vertices: int = 0
    uv_seam_vertices: int = 0
    vertices_without_uv: int = 0
    normal_split_vertices: int = 0
    vertices_without_normal: int = 0
    replaced_normals: int = 0
    turned_normals: int = 0
    colour_split_vertices: int = 0
    vertices_without_colour: int = 0
    clamped_colours: int = 0
    crease_edges: int = 0
    crease_vertices: int = 0
    short_faces: int = 0
    degenerate_faces: int = 0
    duplicate_faces: int = 0
    clashing_edges: int = 0
    flipped_faces: int = 0
    pieces_turned_outward: int = 0
    pieces_left_inside_out: int = 0
    boundary_edges: int = 0
    non_manifold_edges: int = 0
    components: int = 0
    watertight: bool = False
    orientable: bool = True
    extents: list[float] = field(default_factory=list)
    groups: list[dict[str, Any]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types."""
        return asdict(self)

    def warn(self) -> None:
        """Put into words what a user should look at."""
        if self.pieces_turned_outward:
            self.warnings.append(
                f"{self.pieces_turned_outward} closed pieces were inside out and were turned "
                "outward"
            )
        if self.pieces_left_inside_out:
            self.warnings.append(
                f"{self.pieces_left_inside_out} closed pieces are inside out and were left so"
            )
        if not self.orientable:
            self.warnings.append(
                "a piece has no consistent winding (as a Möbius strip): it was left as it is, and "
                "is lit from one side of each triangle"
            )
        if self.non_manifold_edges:
            self.warnings.append(
                f"{self.non_manifold_edges} edges have more than two faces; the winding was not "
                "carried across them"
            )
        if self.has_uv and self.vertices_without_uv:
            self.warnings.append(
                f"{self.vertices_without_uv} vertices have no usable texture coordinate: (0, 0)"
            )
        if self.replaced_normals:
            self.warnings.append(
                f"{self.replaced_normals} vertices have a normal in the file that is zero, not "
                "finite or more than 90 degrees off a face: computed"
            )
        if self.has_normals and self.vertices_without_normal:
            self.warnings.append(
                f"{self.vertices_without_normal} vertices have no normal in the file: computed"
            )
        if self.vertices_without_colour:
            self.warnings.append(
                f"{self.vertices_without_colour} vertices have no colour in the file: white"
            )
        if self.clamped_colours:
            self.warnings.append(
                f"{self.clamped_colours} vertices have a colour outside [0, 1]: clamped"
            )
