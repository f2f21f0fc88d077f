"""Repair of a mesh as it came from a file, and the report of what was found."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from prtbake_storage.errors import MeshError
from prtbake_workers.arrays import B8, F64, I64, Float64, Int64
from prtbake_workers.geometry.mesh import Mesh, face_area_vectors, vertex_normals
from prtbake_workers.geometry.raw_mesh import RawMesh
from prtbake_workers.geometry.topology import consistent_winding, count_components, find_edges

DEGENERATE_HEIGHT = 2.0**-24
"""A triangle lower than this share of the mesh's diagonal has no direction left once its corners
are rounded to the float32 that rays are traced in; dropping it opens a slit no wider than that."""

MAX_COORDINATE = 1e15
"""Beyond this the float32 squares of the ray tracer overflow."""


@dataclass
class MeshReport:
    """What the file held and what the repair did.

    The counts of vertices and faces are ``n_file_*`` before and ``n_*`` after.  Edges are counted
    after the repair, on positions: a UV seam is no boundary.
    """

    format: str = ""
    n_file_vertices: int = 0
    n_file_triangles: int = 0
    n_polygons: int = 0
    n_vertices: int = 0
    n_faces: int = 0
    has_uv: bool = False
    unreferenced_vertices: int = 0
    duplicate_vertices: int = 0
    uv_seam_vertices: int = 0
    vertices_without_uv: int = 0
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
    warnings: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types."""
        return asdict(self)


def repair(raw: RawMesh, format: str, *, orient_outward: bool) -> tuple[Mesh, MeshReport]:
    """Make a mesh that can be baked, and say what was done to it.

    In this order: refuse positions that are not finite; drop unreferenced vertices; merge
    vertices of equal position and texture coordinate; drop degenerate faces, then all but the
    first of faces with the same three positions; make the winding of each piece consistent and
    that of closed pieces outward; compute normals, shared across UV seams.

    Raises
    ------
    MeshError
        A position is not finite (the message names the first), or no triangle is left.
    """
    report = MeshReport(
        format=format,
        n_file_vertices=len(raw.positions),
        n_file_triangles=len(raw.faces),
        n_polygons=raw.n_polygons,
        short_faces=raw.n_short_faces,
        warnings=list(raw.warnings),
    )
    _refuse_unusable(raw)
    positions, faces, uv = _drop_unreferenced(raw, report)
    positions, faces, uv = _merge_duplicates(positions, faces, uv, report)
    faces = _drop_bad_faces(positions, faces, report)
    if not len(faces):
        raise MeshError(
            f"no usable triangle: all {report.n_file_triangles} of the file have no area"
        )
    # faces that went may leave vertices behind
    keep = np.unique(faces)
    renumber = np.zeros(len(positions), np.int64)
    renumber[keep] = np.arange(len(keep))
    positions, faces = positions[keep], renumber[faces]
    uv = None if uv is None else uv[keep]

    place, _ = group_rows(positions)
    faces = _orient(positions, faces, place, report, outward=orient_outward)
    extents = positions.max(axis=0) - positions.min(axis=0)
    report.extents = [float(length) for length in extents]
    report.n_vertices, report.n_faces = len(positions), len(faces)
    report.has_uv = uv is not None
    report.uv_seam_vertices = len(positions) - int(place.max() + 1)
    _warn(report)
    mesh = Mesh(
        positions=positions,
        faces=faces.astype(np.int32),
        normals=vertex_normals(positions, faces, place),
        uv=uv,
    )
    return mesh, report


def group_rows(
    rows: Float64[F64, "verts axes"],
) -> tuple[Int64[I64, " verts"], Int64[I64, " rows"]]:
    """Give equal rows one number, in the order of their first appearance.

    Returns
    -------
    group, first
        Group of each row, and the first row of each group.
    """
    # -0.0 and 0.0 are one position
    order = np.lexsort((rows + 0.0).T[::-1])
    ordered = rows[order]
    new = np.ones(len(rows), np.bool_)
    new[1:] = np.any(ordered[1:] != ordered[:-1], axis=1)
    sorted_group = np.cumsum(new) - 1
    # lexsort is stable, so the first of each run is the first in the file
    first = order[new]
    rank = np.empty(len(first), np.int64)
    by_file = np.argsort(first, kind="stable")
    rank[by_file] = np.arange(len(first))
    group = np.empty(len(rows), np.int64)
    group[order] = rank[sorted_group]
    return group, first[by_file].astype(np.int64)


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


def _drop_unreferenced(raw: RawMesh, report: MeshReport) -> tuple[F64, I64, F64 | None]:
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
    return raw.positions[used] + 0.0, renumber[raw.faces], uv


def _merge_duplicates(
    positions: F64, faces: I64, uv: F64 | None, report: MeshReport
) -> tuple[F64, I64, F64 | None]:
    group, first = group_rows(positions if uv is None else np.hstack([positions, uv]))
    report.duplicate_vertices = len(positions) - len(first)
    return positions[first], group[faces], None if uv is None else uv[first]


def _drop_bad_faces(positions: F64, faces: I64, report: MeshReport) -> I64:
    place, _ = group_rows(positions)
    by_place = place[faces]
    corners = positions[faces]
    edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    double_area = 2.0 * np.linalg.norm(face_area_vectors(positions, faces), axis=1)
    diagonal = float(np.linalg.norm(positions.max(axis=0) - positions.min(axis=0)))
    flat: B8 = double_area <= DEGENERATE_HEIGHT * diagonal * edges.max(axis=1)
    flat = flat | (by_place == np.roll(by_place, 1, axis=1)).any(axis=1)
    report.degenerate_faces = int(np.count_nonzero(flat))
    faces, by_place = faces[~flat], np.sort(by_place[~flat], axis=1)
    if len(faces):
        _, first = np.unique(by_place, axis=0, return_index=True)
        report.duplicate_faces = len(faces) - len(first)
        faces = faces[np.sort(first)]
    return faces


def _orient(positions: F64, faces: I64, place: I64, report: MeshReport, *, outward: bool) -> I64:
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
    return np.where(winding.flip[:, None], faces[:, ::-1], faces)


def _warn(report: MeshReport) -> None:
    """Put into words what a user should look at."""
    if report.pieces_turned_outward:
        report.warnings.append(
            f"{report.pieces_turned_outward} closed pieces were inside out and were turned outward"
        )
    if report.pieces_left_inside_out:
        report.warnings.append(
            f"{report.pieces_left_inside_out} closed pieces are inside out and were left so"
        )
    if not report.orientable:
        report.warnings.append(
            "a piece has no consistent winding (as a Möbius strip): it was left as it is, and is "
            "lit from one side of each triangle"
        )
    if report.non_manifold_edges:
        report.warnings.append(
            f"{report.non_manifold_edges} edges have more than two faces; the winding was not "
            "carried across them"
        )
    if report.has_uv and report.vertices_without_uv:
        report.warnings.append(
            f"{report.vertices_without_uv} vertices have no usable texture coordinate: (0, 0)"
        )
