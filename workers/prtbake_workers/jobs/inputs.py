"""From stored blobs to the core's objects."""

import io
from importlib import metadata
from typing import Any

import numpy as np
from PIL import Image

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.brdf import LambertSpec, brdf_adapter
from prtbake_storage.decode.texture import srgb_to_linear
from prtbake_storage.errors import InputError
from prtbake_storage.hdf5.resources import read_environment, read_mesh
from prtbake_workers.arrays import F32
from prtbake_workers.brdf.base import Brdf
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.environment.environment import Environment
from prtbake_workers.geometry.mesh import Mesh

MAX_TEXTURE_PIXELS = 64_000_000
"""A texture larger than 8k x 8k is refused before it is decoded."""

PACKAGES = ("prtbake", "numpy", "scipy", "embreex", "trimesh", "h5py")


def load_mesh(store: BlobStore, digest: str) -> tuple[Mesh, dict[str, Any]]:
    """Load a registered mesh and what parsing found in it."""
    file = read_mesh(store.local_path(digest))
    return Mesh(file.positions, file.faces, file.normals, file.uv), dict(file.report)


def load_environment(store: BlobStore, digest: str) -> Environment:
    """Load a registered environment."""
    return Environment(read_environment(store.local_path(digest)).radiance)


def load_brdf(spec: dict[str, Any]) -> Brdf:
    """Make the BRDF that a JSON spec describes."""
    return brdf_from_spec(brdf_adapter.validate_python(spec))


def albedo_of(spec: dict[str, Any]) -> F32:
    """Return what multiplies every colour of a part: the Lambertian albedo, else one."""
    if spec["model"] != "lambert":
        return np.ones(1, np.float32)
    albedo = LambertSpec.model_validate(spec).albedo
    return np.atleast_1d(np.asarray(albedo, np.float32))


def load_texture(store: BlobStore, digest: str) -> F32:
    """Decode an 8-bit sRGB picture to linear Rec.709, rows from the top.

    Raises
    ------
    InputError
        The blob is no picture that Pillow reads, or too large.
    """
    try:
        with Image.open(io.BytesIO(store.read_bytes(digest)), formats=("PNG", "JPEG")) as image:
            if image.width * image.height > MAX_TEXTURE_PIXELS:
                raise InputError(
                    f"the albedo texture has {image.width} x {image.height} pixels, "
                    f"more than {MAX_TEXTURE_PIXELS}",
                    pointer="/albedo_texture",
                )
            encoded = np.asarray(image.convert("RGB"), np.float32) / np.float32(255.0)
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"the albedo texture is not a PNG or JPEG picture: {error}", pointer="/albedo_texture"
        ) from error
    return srgb_to_linear(encoded)


def versions() -> dict[str, str]:
    """Name the packages that a result depends on, with their versions."""
    return {name: metadata.version(name) for name in PACKAGES}
