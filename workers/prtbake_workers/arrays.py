"""Array types with named axes.

``Float32[F32, "verts coeffs"]`` gives mypy the dtype and the reader the shape; the shapes are
checked at run time in the tests only.  Axis names: ``verts tris dirs rays samples texels terms
coeffs lobes clusters ranks pcs channels pixels``.
"""

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32, Int64, UInt8
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
B8 = NDArray[np.bool_]
U8 = NDArray[np.uint8]

__all__ = [
    "B8", "F32", "F64", "I32", "I64", "U8",
    "Bool", "Float", "Float32", "Float64", "Int", "Int32", "Int64", "UInt8",
]  # fmt: skip
