"""Named arrays and a JSON header in one HDF5 file: what stages hand to each other.

Intermediate results only; artefacts that people download have schemas of their own.  The bytes
depend on nothing but the content.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import CorruptArtefact


def write_bundle(
    path: Path,
    arrays: Mapping[str, NDArray[Any]],
    header: Mapping[str, Any],
    *,
    gzip_level: int = 1,
) -> Path:
    """Write arrays (names may hold ``/``) and a header; return the path.

    ``gzip_level`` 0 is for arrays that do not shrink and are read by many.
    """
    with h5py.File(path, "w", libver=("v110", "v110"), track_order=False) as file:
        file.attrs["format"] = "prtbake-bundle"
        text = json.dumps(header, sort_keys=True).encode()
        file.create_dataset("header", data=np.frombuffer(text, np.uint8), track_times=False)
        for name in sorted(arrays):
            array = np.ascontiguousarray(arrays[name])
            options: dict[str, Any] = {}
            if array.size > 64:
                options = {"fletcher32": True}
                if gzip_level:
                    options |= {"compression": "gzip", "compression_opts": gzip_level}
                    options |= {"shuffle": True}
            file.create_dataset(f"arrays/{name}", data=array, track_times=False, **options)
    return path


def read_bundle(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read what :func:`write_bundle` wrote.

    Raises
    ------
    CorruptArtefact
        The file is not a bundle, or fails a checksum.
    """
    arrays: dict[str, NDArray[Any]] = {}
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != "prtbake-bundle":
                raise CorruptArtefact(f"{path.name} is not a prtbake bundle")
            header = json.loads(bytes(file["header"][()]))

            def collect(name: str, node: object) -> None:
                if isinstance(node, h5py.Dataset):
                    arrays[name] = node[()]

            if "arrays" in file:
                file["arrays"].visititems(collect)
    except (OSError, KeyError, ValueError) as error:
        raise CorruptArtefact(f"{path.name}: {error}") from error
    return arrays, header
