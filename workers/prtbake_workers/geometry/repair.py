"""Repair of a mesh as it came from a file."""

from dataclasses import dataclass, replace

import numpy as np

from prtbake_storage.errors import MeshError, SettingsError
from prtbake_workers.arrays import B8, F32, F64, I32, I64
from prtbake_workers.geometry.creases import smoothing_groups, split_corners
from prtbake_workers.geometry.face_groups import settle_groups
from prtbake_workers.geometry.given_normals import complete_normals, settle_normals, unit_normals
from prtbake_workers.geometry.grouping import group_rows
from prtbake_workers.geometry.mesh import Mesh, face_area_vectors, vertex_normals
from prtbake_workers.geometry.mesh_report import MeshReport
from prtbake_workers.geometry.raw_mesh import RawMesh
from prtbake_workers.geometry.topology import consistent_winding, count_components, find_edges
from prtbake_workers.geometry.vertex_colours import settle_colours

DEGENERATE_HEIGHT = 2.0**-24
"""A triangle lower than this share of the mesh's diagonal has no direction left once its corners
are rounded to the float32 that rays are traced in; dropping it opens a slit no wider than that."""

MAX_COORDINATE = 1e15
"""Beyond this the float32 squares of the ray tracer overflow."""

_NO_NORMAL = 2.0
"""Stands for a missing normal where vertices are compared: no unit vector has it."""


@dataclass(frozen=True, eq=False)
class _Vertices:
    """Vertices on their way through the repair.

    ``normals`` as `unit_normals` gives them; ``copies`` vertices of the file were merged into each.
    """

    positions: F64
    uv: F64 | None
    normals: F64 | None
    colours: F32 | None
    copies: I64

    def take(self, rows: I64) -> "_Vertices":
        """Give the vertices in ``rows``."""
        return _Vertices(
            self.positions[rows],
            None if self.uv is None else self.uv[rows],
            None if self.normals is None else self.normals[rows],
            None if self.colours is None else self.colours[rows],
            self.copies[rows],
        )

    def group(self, *, by_normal: bool = True, by_colour: bool = True) -> tuple[I64, I64]:
        """Give equal vertices one number, see `group_rows`."""
        columns = [self.positions] if self.uv is None else [self.positions, self.uv]
        if by_normal and self.normals is not None:
            columns.append(np.nan_to_num(self.normals, nan=_NO_NORMAL))
        if by_colour and self.colours is not None:
            columns.append(self.colours.astype(np.float64))
        return group_rows(np.hstack(columns))


def repair(
    raw: RawMesh, format: str, *, orient_outward: bool, crease_angle_deg: float | None = None
) -> tuple[Mesh, MeshReport]:
    """Make a mesh that can be baked, and say what was done to it.

    In this order: refuse positions that are not finite; drop unreferenced vertices; merge
    vertices of equal position, texture coordinate, normal and colour; drop degenerate faces, then
    all but the first of faces with the same three positions; make the winding of each piece
    consistent and that of closed pieces outward; see to the normals.  Faces keep their groups.

    Parameters
    ----------
    raw
        What the reader found.
    format
        For the report.
    orient_outward
        Turn closed pieces that are inside out.
    crease_angle_deg
        None keeps what the file says: its normals where it gives them and they fit the faces, and
        elsewhere smooth ones, shared by all corners at a position.  A number in (0, 180] takes no
        normal of the file: vertices are split along edges whose face normals differ by more, and
        the normals of each smoothing group computed.

    Raises
    ------
    MeshError
        A position is not finite (the message names the first), or no triangle is left.
    SettingsError
        The crease angle is out of range.
    """
    if crease_angle_deg is not None and not 0.0 < crease_angle_deg <= 180.0:
        raise SettingsError(
            f"crease_angle_deg must lie in (0, 180], not {crease_angle_deg:g}",
            pointer="/crease_angle_deg",
        )
    report = MeshReport(
        format=format,
        n_file_vertices=len(raw.positions),
        n_file_triangles=len(raw.faces),
        n_polygons=raw.n_polygons,
        short_faces=raw.n_short_faces,
        warnings=list(raw.warnings),
    )
    _refuse_unusable(raw)
    vertices, faces = _drop_unreferenced(raw, report, with_normals=crease_angle_deg is None)
    vertices, faces = _merge_duplicates(vertices, faces, report)
    kept = _usable_faces(vertices.positions, faces, report)
    faces = faces[kept]
    if not len(faces):
        raise MeshError(
            f"no usable triangle: all {report.n_file_triangles} of the file have no area"
        )
    # faces that went may leave vertices behind
    keep = np.unique(faces)
    renumber = np.zeros(len(vertices.positions), np.int64)
    renumber[keep] = np.arange(len(keep))
    vertices, faces = vertices.take(keep), renumber[faces]

    place, _ = group_rows(vertices.positions)
    flip = _choose_winding(vertices.positions, faces, place, report, outward=orient_outward)
    faces = np.where(flip[:, None], faces[:, ::-1], faces)
    vertices, faces, normals = (
        _file_normals(vertices, faces, flip, report)
        if crease_angle_deg is None
        else _creased_normals(vertices, faces, crease_angle_deg, report)
    )
    positions = vertices.positions
    report.extents = [float(x) for x in positions.max(axis=0) - positions.min(axis=0)]
    report.n_vertices, report.n_faces = len(positions), len(faces)
    report.has_uv = vertices.uv is not None
    of_face, names = _groups(raw, kept, report)
    report.warn()
    mesh = Mesh(
        positions, faces.astype(np.int32), normals, vertices.uv, vertices.colours, of_face, names
    )
    return mesh, report


def _file_normals(
    vertices: _Vertices, faces: I64, flip: B8, report: MeshReport
) -> tuple[_Vertices, I64, F64]:
    """Take the normals of the file where they can be used, and compute the others."""
    if vertices.normals is not None:
        settled = settle_normals(vertices.positions, faces, flip, vertices.normals)
        report.vertices_without_normal = int(vertices.copies[settled.missing].sum())
        report.replaced_normals = int(vertices.copies[settled.refused].sum())
        report.turned_normals = int(vertices.copies[settled.turned].sum())
        report.has_normals = bool(settled.normals.any())
        vertices = replace(vertices, normals=settled.normals)
        # those turned over, or to be computed, may have become equal
        vertices, faces = _merge_duplicates(vertices, faces, report)
    place, first = group_rows(vertices.positions)
    n_with_uv = len(vertices.group(by_normal=False, by_colour=False)[1])
    n_with_normal = len(vertices.group(by_colour=False)[1])
    report.uv_seam_vertices = n_with_uv - len(first)
    report.normal_split_vertices = n_with_normal - n_with_uv
    report.colour_split_vertices = len(place) - n_with_normal
    if vertices.normals is None:
        return vertices, faces, vertex_normals(vertices.positions, faces, place)
    normals = complete_normals(vertices.positions, faces, place, vertices.normals)
    return vertices, faces, normals


def _creased_normals(
    vertices: _Vertices, faces: I64, crease_angle_deg: float, report: MeshReport
) -> tuple[_Vertices, I64, F64]:
    """Split the vertices along creases, and compute the normals of each smoothing group."""
    place, first = group_rows(vertices.positions)
    n_with_uv = len(vertices.group(by_colour=False)[1])
    report.uv_seam_vertices = n_with_uv - len(first)
    report.colour_split_vertices = len(place) - n_with_uv
    groups, report.crease_edges = smoothing_groups(
        vertices.positions, faces, place, crease_angle_deg
    )
    faces, source, group = split_corners(faces, groups)
    report.crease_vertices = len(source) - len(place)
    vertices = vertices.take(source)
    owner = np.unique(group, return_inverse=True)[1].astype(np.int64)
    return vertices, faces, vertex_normals(vertices.positions, faces, owner)


def _refuse_unusable(raw: RawMesh) -> None:
    if not len(raw.faces):
        what = f"{len(raw.positions)} points" if len(raw.positions) else "nothing"
        raise MeshError(f"the file has no triangle: it holds {what}")
    for problem, bad in (
        ("is not finite", ~np.isfinite(raw.positions)),
        (f"exceeds {MAX_COORDINATE:g}", np.abs(raw.positions) > MAX_COORDINATE),
    ):
        rows = np.flatnonzero(bad.any(axis=1))
        if len(rows):
            index = int(rows[0] if raw.vertex_labels is None else raw.vertex_labels[rows[0]])
            value = ", ".join(f"{x:g}" for x in raw.positions[rows[0]])
            raise MeshError(
                f"vertex {index} (counted from 0): position ({value}) {problem}; "
                f"{len(rows)} such vertices in all"
            )


def _drop_unreferenced(
    raw: RawMesh, report: MeshReport, *, with_normals: bool
) -> tuple[_Vertices, I64]:
    n = len(raw.positions)
    outside = np.flatnonzero((raw.faces < 0).any(axis=1) | (raw.faces >= n).any(axis=1))
    if len(outside):
        corners = ", ".join(str(int(i)) for i in raw.faces[outside[0]])
        raise MeshError(
            f"triangle {outside[0]} (counted from 0): corners ({corners}), but the file has "
            f"{n} vertices"
        )
    used = np.unique(raw.faces)
    renumber = np.zeros(n, np.int64)
    renumber[used] = np.arange(len(used))
    report.unreferenced_vertices = n - len(used)
    uv = None
    if raw.uv is not None:
        missing: B8 = np.any(~np.isfinite(raw.uv[used]), axis=1)
        report.vertices_without_uv = int(np.count_nonzero(missing))
        if not missing.all():
            uv = np.where(missing[:, None], 0.0, raw.uv[used])
    normals = None
    if with_normals and raw.normals is not None:
        normals = unit_normals(raw.normals[used])
        if np.isnan(normals).any(axis=1).all():
            normals = None
    colours = None
    if raw.colours is not None:
        labels = used if raw.vertex_labels is None else raw.vertex_labels[used]
        colours = settle_colours(raw.colours.take(used), labels, report)
    vertices = _Vertices(
        positions=raw.positions[used] + 0.0,
        uv=uv,
        normals=normals,
        colours=colours,
        copies=np.ones(len(used), np.int64),
    )
    return vertices, renumber[raw.faces]


def _merge_duplicates(vertices: _Vertices, faces: I64, report: MeshReport) -> tuple[_Vertices, I64]:
    group, first = vertices.group()
    report.duplicate_vertices += len(group) - len(first)
    copies = np.bincount(group, vertices.copies).astype(np.int64)
    return replace(vertices.take(first), copies=copies), group[faces]


def _usable_faces(positions: F64, faces: I64, report: MeshReport) -> I64:
    """Find the faces that have an area and are the first at their three positions."""
    place, _ = group_rows(positions)
    by_place = place[faces]
    corners = positions[faces]
    edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    double_area = 2.0 * np.linalg.norm(face_area_vectors(positions, faces), axis=1)
    diagonal = float(np.linalg.norm(positions.max(axis=0) - positions.min(axis=0)))
    flat: B8 = double_area <= DEGENERATE_HEIGHT * diagonal * edges.max(axis=1)
    flat = flat | (by_place == np.roll(by_place, 1, axis=1)).any(axis=1)
    report.degenerate_faces = int(np.count_nonzero(flat))
    kept: I64 = np.flatnonzero(~flat)
    if len(kept):
        _, first = np.unique(np.sort(by_place[kept], axis=1), axis=0, return_index=True)
        report.duplicate_faces = len(kept) - len(first)
        kept = kept[np.sort(first)]
    return kept


def _groups(raw: RawMesh, kept: I64, report: MeshReport) -> tuple[I32 | None, tuple[str, ...]]:
    """Name the groups of the faces that are left, and count them."""
    if raw.face_groups is None:
        return None, ()
    settled = settle_groups(raw.group_names, raw.face_groups[kept])
    counts = np.bincount(settled.of_face)
    report.groups = [
        {"name": name, "faces": int(count)}
        for name, count in zip(settled.names, counts, strict=True)
    ]
    report.warnings += settled.warnings
    return settled.of_face, settled.names


def _choose_winding(
    positions: F64, faces: I64, place: I64, report: MeshReport, *, outward: bool
) -> B8:
    """Look at the topology, and say which faces to turn over."""
    edges = find_edges(place[faces])
    report.boundary_edges = edges.n_boundary
    report.non_manifold_edges = edges.n_non_manifold
    report.clashing_edges = int(np.count_nonzero(edges.clashing))
    report.components = count_components(place[faces])
    report.watertight = report.boundary_edges == 0 and report.non_manifold_edges == 0
    winding = consistent_winding(positions, faces, edges, outward=outward)
    report.flipped_faces = int(np.count_nonzero(winding.flip))
    report.orientable = winding.orientable
    report.pieces_turned_outward = winding.n_turned_outward
    report.pieces_left_inside_out = winding.n_inward_left
    return winding.flip
