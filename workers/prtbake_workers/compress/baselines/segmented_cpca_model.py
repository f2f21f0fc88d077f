"""The result of all-frequency CPCA."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.compress.cpca_model import CpcaModel


@dataclass(frozen=True, kw_only=True)
class SegmentedCpcaModel:
    """A transfer tensor as one CPCA model for each segment of its light axis.

    Attributes
    ----------
    segments
        Texels of each segment.
    models
        CPCA of the (view, light) matrices of all vertices in each segment, light last.
    view_basis
        Orthonormal columns that reduce the rows of every segment; None where they are kept.
    objective
        Squared error, weighted by the vertices' weights, of all segments and of the view basis
        together; one entry, for nothing is iterated over all segments.
    initial_energy
        Squared norm of the tensor with the same weights.
    squared_error_per_vertex
        Squared error of each vertex, without its weight.
    seed
        Start of the clusterings.
    """

    segments: list[Int64[I64, " _"]]
    models: list[CpcaModel]
    view_basis: Float32[F32, "rows r_view"] | None
    objective: list[float]
    initial_energy: float
    squared_error_per_vertex: Float64[F64, " verts"]
    seed: int

    @property
    def nbytes(self) -> int:
        """Bytes of the float32 factors as they are held."""
        shared = 0 if self.view_basis is None else self.view_basis.nbytes
        return shared + sum(model.nbytes for model in self.models)

    @property
    def squared_error_ratio(self) -> float:
        """Squared error over squared norm, both weighted; 0 for a tensor of zeros."""
        return self.objective[-1] / self.initial_energy if self.initial_energy > 0.0 else 0.0

    def reconstruct(self, verts: slice | None = None) -> Float32[F32, "part_verts rows texels"]:
        """Return the approximated transfer of ``verts``, or of every vertex."""
        n_texels = sum(len(texels) for texels in self.segments)
        transfer: F32 | None = None
        for texels, model in zip(self.segments, self.models, strict=True):
            signal = model.reconstruct(verts)
            rows = signal.reshape(len(signal), signal.shape[1] // len(texels), len(texels))
            if self.view_basis is not None:
                rows = self.view_basis @ rows
            if transfer is None:
                transfer = np.zeros((*rows.shape[:2], n_texels), dtype=np.float32)
            transfer[:, :, texels] = rows
        assert transfer is not None  # a model has a segment at least
        return transfer
