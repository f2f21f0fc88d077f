"""The container of the EPFL material database (.bsdf): named arrays in one file."""

import struct
from collections.abc import Mapping
from math import prod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import BrdfError

SIGNATURE = b"tensor_file\0"
VERSION = (1, 0)
MAX_FIELDS = 64
MAX_AXES = 8

DTYPES: tuple[str | None, ...] = (
    None, "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8",
)  # fmt: skip
"""Types of numbers by the code that stands for them; 0 stands for none."""


class _Cursor:
    """Reads little-endian numbers from the front of a file and says where it ends."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def bytes(self, count: int, what: str) -> bytes:
        taken = self._data[self._at : self._at + count]
        if len(taken) < count:
            raise BrdfError(f"the file ends after {len(self._data)} bytes, within {what}")
        self._at += count
        return taken

    def numbers(self, layout: str, what: str) -> tuple[int, ...]:
        return struct.unpack("<" + layout, self.bytes(struct.calcsize("<" + layout), what))


class _Field(NamedTuple):
    name: str
    dtype: np.dtype[np.generic]
    offset: int
    shape: tuple[int, ...]


def is_tensor_file(data: bytes) -> bool:
    """Tell whether the bytes begin with the container's signature."""
    return data.startswith(SIGNATURE)


def read_tensor_file(data: bytes) -> Mapping[str, NDArray[np.generic]]:
    """Give the arrays of a file by name, as views of its bytes.

    After the signature stand the version (two bytes), the number of fields (uint32), and for each
    field: length of the name (uint16), name, number of axes (uint16), type (uint8), offset of the
    data in the file (uint64), and the length of each axis (uint64); all little-endian.

    Raises
    ------
    BrdfError
        Another signature, version or type, or sizes that the file does not hold; names the field.
    """
    cursor = _Cursor(data)
    if cursor.bytes(len(SIGNATURE), "the signature") != SIGNATURE:
        raise BrdfError("the file does not begin with 'tensor_file'")
    version = cursor.numbers("BB", "the version")
    if version != VERSION:
        raise BrdfError(f"version {version[0]}.{version[1]} of tensor files is not read, 1.0 is")
    (n_fields,) = cursor.numbers("I", "the number of fields")
    if n_fields > MAX_FIELDS:
        raise BrdfError(f"the file promises {n_fields} fields, more than {MAX_FIELDS}")
    fields = [_read_field(cursor, f"field {index}") for index in range(n_fields)]
    return {field.name: _array(field, data) for field in fields}


def _read_field(cursor: _Cursor, place: str) -> _Field:
    (length,) = cursor.numbers("H", f"the name of {place}")
    name = cursor.bytes(length, f"the name of {place}").decode("utf-8", "replace")
    place = f"field {name!r}"
    n_axes, code, offset = cursor.numbers("HBQ", place)
    if n_axes > MAX_AXES:
        raise BrdfError(f"{place} has {n_axes} axes, more than {MAX_AXES}")
    dtype = DTYPES[code] if code < len(DTYPES) else None
    if dtype is None:
        raise BrdfError(f"{place} holds numbers of the unknown type {code}")
    return _Field(name, np.dtype(dtype), offset, cursor.numbers(f"{n_axes}Q", place))


def _array(field: _Field, data: bytes) -> NDArray[np.generic]:
    # Python's integers do not overflow, whatever the file claims
    count = prod(field.shape)
    end = field.offset + count * field.dtype.itemsize
    if end > len(data) or max(field.shape, default=0) > len(data):
        raise BrdfError(
            f"field {field.name!r} of shape {field.shape} would end at byte {end}, the file at "
            f"{len(data)}"
        )
    flat = np.frombuffer(data, field.dtype, count=count, offset=field.offset)
    return flat.reshape(field.shape)
