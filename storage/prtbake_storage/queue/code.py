"""What the result of a task depends on beside its arguments: the code that makes it."""

import hashlib
import platform
from collections.abc import Mapping
from functools import cache
from importlib import metadata, util
from pathlib import Path

from prtbake_storage.blobs.base import json_digest

PACKAGES = (
    "numpy", "scipy", "embreex", "trimesh", "h5py", "moderngl", "opencv-python-headless",
    "OpenEXR", "pillow", "flip-evaluator", "jinja2",
)  # fmt: skip
"""Packages that make numbers, pictures or files."""

SOURCES = (
    "prtbake_workers",
    "prtbake_storage.decode",
    "prtbake_storage.hdf5",
    "prtbake_storage.contract",
    "prtbake_storage.plots",
)
"""Our own packages that do."""


@cache
def code_version() -> str:
    """Digest of the sources and versions above, and of Python's, in 64 hex digits.

    It is the same in every process of an installation, and costs some 30 ms, once a process.  A
    package that is not installed counts as such: what needs it would fail.
    """
    identity = {
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "sources": {name: source_digests(_folder(name)) for name in SOURCES},
    }
    return json_digest(identity)


def source_digests(folder: Path | None) -> Mapping[str, str]:
    """SHA-256 of each file of a package, templates and shaders too, by its path in the package."""
    if folder is None:
        return {}
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.suffix != ".pyc" and not path.name.startswith(".") and path.is_file()
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _folder(package: str) -> Path | None:
    # found, not imported: the workers' code stands above the storage
    spec = util.find_spec(package)
    places = spec.submodule_search_locations if spec is not None else None
    return Path(places[0]) if places else None
