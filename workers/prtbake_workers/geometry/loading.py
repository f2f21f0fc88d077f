"""Loading a mesh from the bytes of a file."""

from prtbake_storage.errors import MeshError
from prtbake_workers.geometry.foreign_readers import read_foreign
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.mesh_report import MeshReport
from prtbake_workers.geometry.obj_reader import read_obj
from prtbake_workers.geometry.raw_mesh import MeshLimits
from prtbake_workers.geometry.repair import repair

FORMATS = ("obj", "ply", "stl", "off", "glb")
_OBJ_KEYWORDS = {b"v", b"vt", b"vn", b"f", b"o", b"g", b"s", b"mtllib", b"usemtl"}
_SNIFFED_BYTES = 1 << 16


def load_mesh(
    data: bytes,
    format: str,
    *,
    orient_outward: bool = True,
    crease_angle_deg: float | None = None,
    limits: MeshLimits | None = None,
) -> tuple[Mesh, MeshReport]:
    """Read and repair a mesh.

    Parameters
    ----------
    data
        The whole file.  Nothing that it refers to (materials, pictures, buffers) is opened.
    format
        obj, ply, stl, off, glb, or auto: recognised by content.
    orient_outward
        Turn closed pieces that are inside out.  False for rooms that are seen from within.
    crease_angle_deg
        None keeps the normals of the file, and gives smooth ones where it has none; a number in
        (0, 180] computes them, sharp along edges whose faces differ by more (see `repair`).
    limits
        Bounds on what the file may hold; None for the defaults.

    Returns
    -------
    mesh, report
        The mesh, with vertices in the order of the file, and what the repair found and did.

    Raises
    ------
    MeshError
        The file cannot be read, holds positions that are not finite, or no usable triangle; the
        message says what and where.
    TooLarge
        The file exceeds a limit.
    SettingsError
        The crease angle is out of range.
    """
    limits = MeshLimits() if limits is None else limits
    kind = recognise_format(data) if format == "auto" else format.lower()
    if kind not in FORMATS:
        raise MeshError(f"format '{format}' is not one of auto, {', '.join(FORMATS)}")
    raw = read_obj(data, limits) if kind == "obj" else read_foreign(data, kind, limits)
    mesh, report = repair(
        raw, kind, orient_outward=orient_outward, crease_angle_deg=crease_angle_deg
    )
    # creases may have split every corner of every triangle
    limits.check(vertices=mesh.n_vertices)
    return mesh, report


def recognise_format(data: bytes) -> str:
    """Tell the format from the first bytes.

    Raises
    ------
    MeshError
        The content is none of the formats.
    """
    head = data[:_SNIFFED_BYTES]
    if head.startswith(b"glTF"):
        return "glb"
    if head[:3].lower() == b"ply":
        return "ply"
    # a binary STL may begin with "solid" too, but only it has the length that it promises
    if len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):
        return "stl"
    if head.lstrip()[:5].lower() == b"solid" and b"facet" in head.lower():
        return "stl"
    lines = [words for line in head.splitlines() if (words := line.split(b"#", 1)[0].split())]
    if not lines:
        raise MeshError("the file is empty")
    if lines[0][0] in (b"OFF", b"COFF"):
        return "off"
    if any(words[0] in _OBJ_KEYWORDS for words in lines):
        return "obj"
    raise MeshError(
        "the content is none of OBJ, PLY, STL, OFF, GLB: state the format", pointer="/format"
    )
