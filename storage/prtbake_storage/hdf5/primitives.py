"""The few ways in which prtbake writes a dataset, and reads one from a file it does not trust."""

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5 import schema


@contextmanager
def new_file(path: Path, kind: str) -> Iterator[h5py.File]:
    """Write a file under a temporary name; on success sync it and rename it to ``path``.

    On failure nothing is left behind.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with h5py.File(partial, "w", libver=schema.LIBVER, track_times=False) as file:
            _set_header(file, kind)
            yield file
        _sync(partial)
        partial.replace(path)
        _sync(path.parent)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def file_in_memory(kind: str) -> Iterator[h5py.File]:
    """Lay out a file as `new_file` does, in memory alone."""
    with h5py.File(
        kind, "w", driver="core", backing_store=False, libver=schema.LIBVER, track_times=False
    ) as file:
        _set_header(file, kind)
        yield file


def _set_header(file: h5py.File, kind: str) -> None:
    set_attribute(file, "format", schema.FORMAT)
    set_attribute(file, "version", schema.VERSION)
    set_attribute(file, "kind", kind)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def group(parent: h5py.Group, name: str) -> h5py.Group:
    """Create a group without times."""
    return parent.create_group(name, track_times=False)


def put(
    parent: h5py.Group,
    name: str,
    array: NDArray[Any],
    axes: str,
    *,
    unit: str | None = None,
) -> h5py.Dataset:
    """Write an array; ``axes`` names its axes."""
    dataset = create(parent, name, array.shape, array.dtype, axes, unit=unit)
    dataset[...] = array
    return dataset


def create(
    parent: h5py.Group,
    name: str,
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    axes: str,
    *,
    unit: str | None = None,
    chunk_rows: int | None = None,
    growing: bool = False,
    level: int = schema.GZIP_LEVEL,
) -> h5py.Dataset:
    """Create an empty dataset with prtbake's filters; ``chunk_rows`` fixes the first chunk edge."""
    if len(axes.split()) != len(shape):
        raise ValueError(f"{name}: axes {axes!r} do not name the {len(shape)} axes of {shape}")
    row_bytes = max(1, int(np.prod(shape[1:], dtype=np.int64)) * np.dtype(dtype).itemsize)
    rows = chunk_rows or max(1, min(shape[0], schema.CHUNK_BYTES // row_bytes))
    dataset = parent.create_dataset(
        name,
        shape=shape,
        dtype=np.dtype(dtype).newbyteorder("<"),
        chunks=(rows, *shape[1:]),
        maxshape=(None, *shape[1:]) if growing else None,
        compression="gzip",
        compression_opts=level,
        shuffle=True,
        fletcher32=True,
        track_times=False,
    )
    set_attribute(dataset, "axes", axes)
    if unit is not None:
        set_attribute(dataset, "unit", unit)
    return dataset


def put_json(parent: h5py.Group, name: str, value: Any) -> None:
    """Write a JSON value as canonical text."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    data = np.array([text.encode("utf-8") or b" "])
    written = parent.create_dataset(
        name, data=data, chunks=(1,), compression="gzip", fletcher32=True, track_times=False
    )
    set_attribute(written, "axes", "json")


def set_attribute(owner: h5py.Group | h5py.Dataset, name: str, value: str | int | float) -> None:
    """Write a scalar; text goes in as fixed-length UTF-8, inside the checksummed header."""
    owner.attrs[name] = np.bytes_(value.encode("utf-8")) if isinstance(value, str) else value


@contextmanager
def open_file(path: Path, kind: str) -> Iterator[h5py.File]:
    """Open a file of a known kind; whatever the library finds wrong becomes CorruptArtefact."""
    try:
        file = h5py.File(path, "r", locking=False)
    except FileNotFoundError:
        raise
    except (OSError, RuntimeError, KeyError) as error:
        raise CorruptArtefact(f"the file is damaged or no HDF5: {error}") from error
    with file:
        expected = {"format": schema.FORMAT, "version": schema.VERSION, "kind": kind}
        for name, value in expected.items():
            found = attribute(file, name)
            if found != value:
                raise CorruptArtefact(f"attribute {name!r} is {found!r}, not {value!r}")
        yield file


def attribute(owner: h5py.Group | h5py.Dataset, name: str) -> Any:
    """Read a scalar attribute as str, int or float."""
    try:
        value = owner.attrs[name]
    except (KeyError, OSError, RuntimeError, TypeError, ValueError) as error:
        raise CorruptArtefact(f"{owner.name}: no readable attribute {name!r}") from error
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if not isinstance(value, str | int | float):
        raise CorruptArtefact(f"{owner.name}: attribute {name!r} is not a scalar")
    return value


def has_attribute(owner: h5py.Group | h5py.Dataset, name: str) -> bool:
    """Whether there is an attribute of that name."""
    try:
        return name in owner.attrs
    except (OSError, RuntimeError) as error:
        raise CorruptArtefact(f"{owner.name}: its attributes cannot be listed") from error


def child(parent: h5py.Group, name: str) -> h5py.Group:
    """Return a sub-group that lies in this very file."""
    found = _member(parent, name)
    if not isinstance(found, h5py.Group):
        raise CorruptArtefact(f"{_path(parent, name)} is not a group")
    return found


def dataset(parent: h5py.Group, name: str, kinds: str, axes: int) -> h5py.Dataset:
    """Return a dataset after checking type, axes, filters and honesty of its claimed size."""
    return _checked(_member(parent, name), _path(parent, name), kinds, axes)


def _checked(found: Any, path: str, kinds: str, axes: int | None) -> h5py.Dataset:
    if not isinstance(found, h5py.Dataset):
        raise CorruptArtefact(f"{path} is not a dataset")
    # each of these asks the library anew
    dtype, shape, plist = found.dtype, found.shape, found.id.get_create_plist()
    if dtype.kind not in kinds or dtype.hasobject or dtype.names:
        raise CorruptArtefact(f"{path} holds {dtype}, not one of {kinds!r}")
    if shape is None or axes not in (None, len(shape)):
        raise CorruptArtefact(f"{path} has shape {shape}, not {axes} axes")
    if plist.get_layout() != h5py.h5d.CHUNKED:
        raise CorruptArtefact(f"{path} is not stored as chunks of this file")
    filters = {plist.get_filter(i)[0] for i in range(plist.get_nfilters())}
    if not filters <= schema.ALLOWED_FILTERS:
        raise CorruptArtefact(f"{path} uses unknown filters {sorted(filters)}")
    n_bytes = math.prod(shape) * dtype.itemsize
    if n_bytes > schema.MAX_DEFLATE_RATIO * found.id.get_storage_size() + 4096:
        raise CorruptArtefact(f"{path} claims {n_bytes} bytes that were never written")
    return found


def get(parent: h5py.Group, name: str, kinds: str, shape: tuple[int | None, ...]) -> NDArray[Any]:
    """Read an array; ``None`` in ``shape`` leaves that axis free; numbers must be finite."""
    found = dataset(parent, name, kinds, len(shape))
    path = _path(parent, name)
    if any(want not in (None, have) for want, have in zip(shape, found.shape, strict=True)):
        raise CorruptArtefact(f"{path} has shape {found.shape}, not {shape}")
    return read(found)


def get_int32(parent: h5py.Group, name: str, shape: tuple[int | None, ...]) -> NDArray[np.int32]:
    """Read integers of at most 32 bits: wider ones would wrap."""
    array = get(parent, name, "i", shape)
    if array.dtype.itemsize > 4:
        raise CorruptArtefact(f"{_path(parent, name)} is {array.dtype}, of more than 32 bits")
    return array.astype(np.int32)


def read(source: h5py.Dataset, selection: Any = ()) -> NDArray[Any]:
    """Read a checked dataset; a failed checksum or a non-finite number names the dataset."""
    try:
        array: NDArray[Any] = np.asarray(source[selection])
    except (OSError, RuntimeError) as error:
        raise CorruptArtefact(f"{source.name} cannot be read: {error}") from error
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise CorruptArtefact(f"{source.name} is not finite at {place}")
    return array


def get_json(parent: h5py.Group, name: str) -> Any:
    """Read JSON text."""
    found = dataset(parent, name, "S", 1)
    path = _path(parent, name)
    if found.shape != (1,) or found.dtype.itemsize > schema.MAX_JSON_BYTES:
        raise CorruptArtefact(f"{path} is no JSON text of reasonable length")
    try:
        return json.loads(bytes(read(found)[0]))
    except ValueError as error:
        raise CorruptArtefact(f"{path} is no JSON: {error}") from error


def get_object(parent: h5py.Group, name: str) -> Mapping[str, Any]:
    """Read JSON text that must be an object."""
    value = get_json(parent, name)
    if not isinstance(value, dict):
        raise CorruptArtefact(f"{_path(parent, name)} is no JSON object")
    return value


def get_any(parent: h5py.Group, name: str, kinds: str) -> NDArray[Any]:
    """Read an array of any shape."""
    return read(_checked(_member(parent, name), _path(parent, name), kinds, None))


def names(parent: h5py.Group) -> list[str]:
    """Names of the group's members; following no link."""
    try:
        return sorted(parent.keys())
    except (OSError, RuntimeError) as error:
        raise CorruptArtefact(f"{parent.name} cannot be listed: {error}") from error


def has(parent: h5py.Group, name: str) -> bool:
    """Whether the group has a member of that name; following no link."""
    return name in names(parent)


def _member(parent: h5py.Group, name: str) -> Any:
    path = _path(parent, name)
    try:
        links, key = parent.id.links, name.encode("utf-8")
        if not links.exists(key):
            raise CorruptArtefact(f"{path} is missing")
        if links.get_info(key).type != h5py.h5l.TYPE_HARD:
            raise CorruptArtefact(f"{path} is a link, not data of this file")
        return parent[name]
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, CorruptArtefact):
            raise
        raise CorruptArtefact(f"{path} cannot be read: {error}") from error


def _path(parent: h5py.Group, name: str) -> str:
    return f"{parent.name.rstrip('/')}/{name}"
