"""From stored blobs to the core's objects."""

from importlib import metadata
from typing import Any

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.brdf import MeasuredSpec, stored_brdf_adapter
from prtbake_storage.errors import InputError
from prtbake_storage.hdf5.brdf import BrdfFile, read_brdf
from prtbake_storage.hdf5.resources import read_mesh
from prtbake_workers.arrays import F32
from prtbake_workers.brdf.base import Brdf
from prtbake_workers.brdf.half_difference_table import HalfDifferenceTable
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.brdf.rgl import RglTensor
from prtbake_workers.brdf.rgl_oriented import OrientedRglTensor
from prtbake_workers.brdf.symmetrised import Symmetrised, SymmetrisedOriented
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.render.images import read_albedo_texture

PACKAGES = ("prtbake", "numpy", "scipy", "embreex", "trimesh", "h5py")


def load_mesh(store: BlobStore, digest: str) -> tuple[Mesh, dict[str, Any]]:
    """Load a registered mesh and what parsing found in it."""
    file = read_mesh(store.local_path(digest))
    mesh = Mesh(
        file.positions,
        file.faces,
        file.normals,
        file.uv,
        file.colours,
        file.face_groups,
        file.group_names,
    )
    return mesh, dict(file.report)


def load_brdf(store: BlobStore, spec: dict[str, Any]) -> Brdf:
    """Make the BRDF that a JSON spec describes, from the blob that it names if it is measured."""
    stored = stored_brdf_adapter.validate_python(spec)
    if isinstance(stored, MeasuredSpec):
        return measured_brdf(read_brdf(store.local_path(stored.data)))
    return brdf_from_spec(stored)


def measured_brdf(file: BrdfFile) -> Brdf:
    """Make the BRDF of a canonical file."""
    if file.parametrisation == "rgl":
        return Symmetrised(RglTensor(**file.arrays))
    if file.parametrisation == "rgl_oriented":
        tensor = OrientedRglTensor(**file.arrays)
        return SymmetrisedOriented(tensor, tensor.mirror_images)
    return HalfDifferenceTable(file.arrays["values"])


def load_texture(store: BlobStore, digest: str, *, pointer: str) -> F32:
    """Decode an albedo texture to linear Rec.709, rows from the top; errors have the pointer."""
    try:
        return read_albedo_texture(store.read_bytes(digest))
    except InputError as error:
        raise InputError(error.detail, pointer=pointer) from error


def versions() -> dict[str, str]:
    """Name the packages that a result depends on, with their versions."""
    return {name: metadata.version(name) for name in PACKAGES}
