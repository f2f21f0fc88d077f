import struct

import numpy as np
import pytest

from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.tensor_file import is_tensor_file, read_tensor_file
from support.tensor_file import tensor_bytes

FIELDS = {
    "description": np.frombuffer(b"plain", "u1"),
    "theta_i": np.linspace(0, 1, 5).astype("f4"),
    "rgb": np.arange(24.0).reshape(2, 3, 4),
}
HEAD = b"tensor_file\0\1\0"


def header(name=b"x", axes=1, code=10, offset=40, shape=(1,), n_fields=1):
    text = HEAD + struct.pack("<I", n_fields) + struct.pack("<H", len(name)) + name
    return text + struct.pack("<HBQ", axes, code, offset) + struct.pack(f"<{len(shape)}Q", *shape)


def test_arrays_come_back():
    data = tensor_bytes(FIELDS)
    found = read_tensor_file(data)
    assert list(found) == list(FIELDS)
    for name, array in FIELDS.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    assert is_tensor_file(data)
    assert not is_tensor_file(b"tensor")


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "ends after 0 bytes, within the signature"),
        (b"tensor_film\0\1\0\0\0\0\0", "does not begin with"),
        (HEAD[:13], "within the version"),
        (b"tensor_file\0\2\0\0\0\0\0", "version 2.0"),
        (HEAD + b"\0\0", "within the number of fields"),
        (HEAD + struct.pack("<I", 2**32 - 1), "promises 4294967295 fields"),
        (HEAD + struct.pack("<I", 1), "within the name of field 0"),
        (header(name=b"abc")[:-20], "within field 'abc'|within the name"),
        (header(axes=9), "9 axes"),
        (header(axes=3, shape=(1,)), "within field 'x'"),
        (header(code=0), "unknown type 0"),
        (header(code=12), "unknown type 12"),
        (header(shape=(2**63,)), "would end at byte"),
        (header(axes=2, shape=(2**63, 2**63)), "would end at byte"),
        (header(axes=2, shape=(2**63, 0)), "would end at byte"),
        (header(offset=2**63), "would end at byte 9223372036854775812"),
        (tensor_bytes(FIELDS)[:-1], "field 'rgb' of shape"),
    ],
)
def test_hostile_files_are_refused_with_the_field(data, says):
    with pytest.raises(BrdfError, match=says):
        read_tensor_file(data)


@pytest.mark.parametrize("keep", range(0, 150, 7))
def test_every_truncation_is_refused(keep):
    with pytest.raises(BrdfError):
        read_tensor_file(tensor_bytes(FIELDS)[:keep])
