"""Wavelet compression of transfer: Haar on faces of a cube map, the largest kept [Ng2003]_."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from prtbake_storage.decode.cube_map import N_FACES, face_solid_angles
from prtbake_storage.decode.haar import haar, inverse_haar
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.compress.baselines.largest_coefficients import (
    LargestCoefficientsModel,
    keep_largest,
)
from prtbake_workers.compress.energy import row_chunks
from prtbake_workers.compress.inputs import checked_signal

CHUNK_BYTES = 8 << 20
"""Of samples that are transformed at a time, in float64 and with a copy or two."""


@dataclass(frozen=True)
class WaveletModel:
    """Transfer over a cube map of N x N texels a face, as the Haar coefficients that were kept."""

    kept: LargestCoefficientsModel
    resolution: int

    @property
    def nbytes(self) -> int:
        """Bytes of the float32 coefficients, their places and the counts."""
        return self.kept.nbytes

    @property
    def objective(self) -> list[float]:
        """Squared error, weighted by the vertices' weights; one entry."""
        return self.kept.objective

    @property
    def squared_error_ratio(self) -> float:
        """Squared error over squared norm, both weighted; 0 for a tensor of zeros."""
        return self.kept.squared_error_ratio

    def reconstruct(self, verts: slice | None = None) -> Float32[F32, "part_verts rows texels"]:
        """Return the approximated transfer of ``verts``, or of every vertex."""
        return _transformed(self.kept.reconstruct(verts), self.resolution, inverse=True)


def compress_wavelets(
    transfer: Float[NDArray[Any], "verts rows texels"],
    n_kept: int,
    *,
    vertex_weights: NDArray[Any] | None = None,
) -> WaveletModel:
    """Keep the largest Haar coefficients of all vertices, by area.

    Parameters
    ----------
    transfer
        float32 transfer over the texels of a cube map, faces one after the other, row by row, times
        the root of the texels' solid angles and with orthonormal view functions, so that squared
        errors are squared radiance errors.
    n_kept, vertex_weights
        As `keep_largest` takes them.

    Raises
    ------
    SettingsError
        For what cannot be used; for texels that are not six squares of a power of two.

    Notes
    -----
    The transform is orthonormal, so what is dropped is the error.  Its wavelets have the shape of
    the texels' exact solid angles.
    """
    t = checked_signal(transfer, "transfer", ("verts", "rows", "texels"))
    resolution = round((t.shape[2] / N_FACES) ** 0.5)
    if N_FACES * resolution**2 != t.shape[2] or resolution & (resolution - 1):
        raise SettingsError(
            f"{t.shape[2]} texels are not six squares of a power of two", pointer="/transfer"
        )
    coefficients = _transformed(t, resolution, inverse=False)
    return WaveletModel(
        keep_largest(coefficients, n_kept, vertex_weights=vertex_weights), resolution
    )


def _transformed(
    rows: Float32[F32, "verts rows texels"], resolution: int, *, inverse: bool
) -> Float32[F32, "verts rows texels"]:
    """Turn samples times root solid angles into coefficients, or back, block by block."""
    flat = rows.reshape(-1, rows.shape[2])
    roots = _roots(resolution)
    out = np.empty_like(flat)
    for chunk in row_chunks(flat, CHUNK_BYTES):
        part = flat[chunk].T.astype(np.float64)
        turned = (
            inverse_haar(part, resolution) * roots if inverse else haar(part / roots, resolution)
        )
        out[chunk] = turned.T
    return out.reshape(rows.shape)


def _roots(resolution: int) -> Float64[F64, "texels 1"]:
    return np.tile(np.sqrt(face_solid_angles(resolution)).reshape(-1, 1), (N_FACES, 1))
