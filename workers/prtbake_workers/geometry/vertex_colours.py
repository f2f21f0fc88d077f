"""The vertex colours that a file gives: made linear, or left out with the reason."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from prtbake_storage.decode.texture import srgb_to_linear
from prtbake_workers.arrays import B8, F32, F64, I64, Bool, Float32, Float64, Int64
from prtbake_workers.geometry.mesh_report import MeshReport

Encoding = Literal["srgb", "linear"]

ROUNDING = 1e-6
"""How far beyond [0, 1] a colour may lie: text holds six digits."""


@dataclass(frozen=True, eq=False)
class RawColours:
    """Red, green and blue of each vertex before they are checked.

    Attributes
    ----------
    values
        As in the file, whole numbers divided by the largest of their type; sound ones lie in
        [0, 1].
    given
        Vertices that have a colour; the values of the others mean nothing.
    encoding
        Whether the values are sRGB codes (IEC 61966-2-1) or linear Rec.709.
    clamped
        Whether the format says that values outside [0, 1] are to be clamped.
    """

    values: Float64[F64, "verts 3"]
    given: Bool[B8, " verts"]
    encoding: Encoding
    clamped: bool = False

    def take(self, rows: Int64[I64, " taken"]) -> "RawColours":
        """Give the colours in ``rows``."""
        return RawColours(self.values[rows], self.given[rows], self.encoding, self.clamped)


def join_colours(parts: Sequence[RawColours | None], sizes: Sequence[int]) -> RawColours | None:
    """Join the colours of a file's parts of so many vertices; None where none has any."""
    some = [part for part in parts if part is not None]
    if not some:
        return None
    filled = [
        RawColours(np.ones((size, 3)), np.zeros(size, np.bool_), some[0].encoding)
        if part is None
        else part
        for part, size in zip(parts, sizes, strict=True)
    ]
    return RawColours(
        np.concatenate([part.values for part in filled]),
        np.concatenate([part.given for part in filled]),
        some[0].encoding,
        some[0].clamped,
    )


def settle_colours(
    raw: RawColours, labels: Int64[I64, " verts"], report: MeshReport
) -> Float32[F32, "verts 3"] | None:
    """Decode colours to linear Rec.709 in [0, 1]; None, and a warning, where one is broken.

    Not one broken colour is guessed: a mesh is of use without colours, and what asks for them is
    told that there are none.  Vertices without a colour are white, which multiplies nothing.

    Parameters
    ----------
    raw
        Of the vertices in use.
    labels
        Their numbers in the file, for the warning.
    report
        Gets what was found.
    """
    if not raw.given.any():
        return None
    bad = ~np.isfinite(raw.values)
    outside = (raw.values < -ROUNDING) | (raw.values > 1.0 + ROUNDING)
    if not raw.clamped:
        bad |= outside
    rows = np.flatnonzero(raw.given & bad.any(axis=1))
    if len(rows):
        value = ", ".join(f"{x:g}" for x in raw.values[rows[0]])
        report.warnings.append(
            f"the vertex colours are left out: vertex {labels[rows[0]]} (counted from 0) has "
            f"({value}), not three numbers in [0, 1]; {len(rows)} such vertices in all"
        )
        return None
    report.clamped_colours = int(np.count_nonzero(raw.given & outside.any(axis=1)))
    report.vertices_without_colour = int(np.count_nonzero(~raw.given))
    report.vertex_colours = True
    report.colour_encoding = raw.encoding
    values = np.where(raw.given[:, None], np.clip(raw.values, 0.0, 1.0), 1.0)
    return srgb_to_linear(values) if raw.encoding == "srgb" else values.astype(np.float32)
