"""Every compression by its name: transfer in, a model and the factors of an asset's part out.

Vector quantisation and (clustered) PCA know signals, not tensors.  To them the matrix of a vertex,
channels x terms x coefficients, is one long signal, as [Sloan2003]_ section 3 compresses glossy
transfer.  Terms are orthonormal functions of the view, so the signal's squared error is that of the
radiance.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from prtbake_workers.arrays import F32, F64, I32, Float64, Int32
from prtbake_workers.compress.coherence import Coherence
from prtbake_workers.compress.cpca import compress_cpca
from prtbake_workers.compress.cpca_model import CpcaModel
from prtbake_workers.compress.cta import compress_cta
from prtbake_workers.compress.cta_adaptive import with_own_ranks
from prtbake_workers.compress.cta_model import CtaModel, CtaRanks
from prtbake_workers.compress.less_overdraw import less_overdraw_cpca, less_overdraw_cta
from prtbake_workers.compress.pca import Principal
from prtbake_workers.compress.progress import Progress, no_progress
from prtbake_workers.compress.rows import Rows
from prtbake_workers.compress.vq import compress_vq


@runtime_checkable
class Model(Protocol):
    """What every compression returns."""

    @property
    def labels(self) -> Int32[I32, " verts"]:
        """Cluster of each vertex."""
        ...

    @property
    def objective(self) -> list[float]:
        """Weighted squared error after each step, rising only where coherence or draws are paid."""
        ...

    @property
    def initial_energy(self) -> float:
        """Squared norm of the input with the same weights."""
        ...

    @property
    def squared_error_per_vertex(self) -> Float64[F64, " verts"]:
        """Squared error of each vertex, without its weight."""
        ...

    @property
    def iterations(self) -> int:
        """Rounds that it took."""
        ...

    @property
    def notes(self) -> list[str]:
        """What was cut or left out, in words."""
        ...

    @property
    def n_clusters(self) -> int:
        """Clusters, none of them empty."""
        ...

    @property
    def nbytes(self) -> int:
        """Bytes of the float32 factors."""
        ...

    @property
    def squared_error_ratio(self) -> float:
        """Squared error over squared norm, both weighted."""
        ...

    def reconstruct(self, verts: slice | None = None) -> F32:
        """Return the approximated signal of ``verts``, or of every vertex."""
        ...


@runtime_checkable
class Sizes(Protocol):
    """How much a part's compression may keep; a method reads what it has a use for."""

    @property
    def n_clusters(self) -> int:
        """Clusters."""
        ...

    @property
    def ranks(self) -> tuple[int, int, int]:
        """Of view, light and vertices."""
        ...

    @property
    def n_components(self) -> int:
        """Principal components of a cluster."""
        ...


@dataclass(frozen=True, kw_only=True)
class Fit:
    """How a part is fitted, whatever the method.

    Attributes
    ----------
    seed
        Of everything that is drawn.
    max_iterations
        Rounds of clustering at most.
    n_channels
        Colour channels that the rows hold one after the other.
    vertex_weights
        (verts,) weights in the squared error, e.g. areas; ones when None.
    classification
        Of clustered PCA, one of `prtbake_workers.compress.cpca.METHODS`; with ``adaptive`` clusters
        of tensors have ranks of their own too.
    coherence
        What being far from a cluster on the mesh costs; None for nothing.
    faces
        (tris, 3) corners of the part's triangles; needed with a budget of overdraw.
    overdraw_budget
        Share of the squared error that fewer draws may add; None moves no vertex for them.
    principal
        Of PCA, where several sizes of the same rows are tried; None decomposes them anew.
    progress
        Called with the fraction done and a word on the state.
    """

    seed: int
    max_iterations: int
    n_channels: int = 1
    vertex_weights: NDArray[Any] | None = None
    classification: str = "static"
    coherence: Coherence | None = None
    faces: Int32[I32, "tris 3"] | None = None
    overdraw_budget: float | None = None
    principal: Principal | None = None
    progress: Progress = no_progress


@dataclass(frozen=True, kw_only=True)
class Compressed:
    """A model, and its factors as `prtbake_storage.decode.asset.Part` names them."""

    model: CpcaModel | CtaModel
    factors: Mapping[str, NDArray[Any]] = field(repr=False)


Compressor = Callable[[Rows, Sizes, Fit], CpcaModel | CtaModel]


def compress(method: str, coefficients: Rows, sizes: Sizes, fit: Fit) -> Compressed:
    """Compress the transfer of one part.

    Parameters
    ----------
    method
        One of `METHODS`.
    coefficients
        (verts, rows, coeffs) float32 transfer in an orthonormal basis of the light; row c * terms +
        k of a vertex is term k of channel c, and terms are orthonormal functions of the view.  It
        may lie outside of memory, but what knows signals only reads it whole.
    sizes, fit
        What may be kept, and how it is found.

    Raises
    ------
    SettingsError
        For what the method cannot use, with the argument as pointer.
    """
    return finished(METHODS[method](coefficients, sizes, fit), coefficients, fit)


def finished(model: CpcaModel | CtaModel, coefficients: Rows, fit: Fit) -> Compressed:
    """Do what follows a method's own fit, which leaves ``model``.

    Ranks a cluster at a time, where they are asked for, then fewer draws; and names of the factors.
    """
    if isinstance(model, CtaModel) and fit.classification == "adaptive":
        model = with_own_ranks(
            model,
            coefficients,
            vertex_weights=fit.vertex_weights,
            progress=lambda done, state: fit.progress(
                EVEN_SHARE + (1.0 - EVEN_SHARE) * done, state
            ),
        )
    model = _drawn_less(model, coefficients, fit)
    return Compressed(model=model, factors=factors_of(model, coefficients.shape, fit.n_channels))


def _vq(coefficients: Rows, sizes: Sizes, fit: Fit) -> CpcaModel:
    return compress_vq(
        _signal(coefficients),
        sizes.n_clusters,
        start="spread",
        method="elbg",
        seed=fit.seed,
        max_iterations=fit.max_iterations,
        vertex_weights=fit.vertex_weights,
        coherence=fit.coherence,
        progress=fit.progress,
    )


def _pca(coefficients: Rows, sizes: Sizes, fit: Fit) -> CpcaModel:
    principal = fit.principal or Principal(_signal(coefficients), fit.vertex_weights)
    return principal.model(sizes.n_components, seed=fit.seed, progress=fit.progress)


def _cpca(coefficients: Rows, sizes: Sizes, fit: Fit) -> CpcaModel:
    return compress_cpca(
        _signal(coefficients),
        sizes.n_clusters,
        sizes.n_components,
        method=fit.classification,
        seed=fit.seed,
        max_iterations=fit.max_iterations,
        vertex_weights=fit.vertex_weights,
        coherence=fit.coherence,
        progress=fit.progress,
    )


def _cta(coefficients: Rows, sizes: Sizes, fit: Fit) -> CtaModel:
    share = EVEN_SHARE if fit.classification == "adaptive" else 1.0
    return compress_cta(
        coefficients,
        sizes.n_clusters,
        CtaRanks(*sizes.ranks),
        seed=fit.seed,
        max_iterations=fit.max_iterations,
        vertex_weights=fit.vertex_weights,
        n_channels=fit.n_channels,
        coherence=fit.coherence,
        progress=lambda done, state: fit.progress(share * done, state),
    )


EVEN_SHARE = 0.6
"""Of the time that even ranks and then own ones take, about."""

METHODS: Mapping[str, Compressor] = {"vq": _vq, "pca": _pca, "cpca": _cpca, "cta": _cta}
"""Vector quantisation, principal components, those of clusters, and tensors of clusters."""


def _signal(coefficients: Rows) -> F32:
    """Return the matrix of each vertex as one row, all of them in memory."""
    return coefficients[:].reshape(len(coefficients), -1)


def _drawn_less(model: CpcaModel | CtaModel, coefficients: Rows, fit: Fit) -> CpcaModel | CtaModel:
    """Spend the budget of overdraw, where there is one."""
    if fit.overdraw_budget is None or fit.faces is None:
        return model
    budget, weights = fit.overdraw_budget, fit.vertex_weights
    if isinstance(model, CtaModel):
        return less_overdraw_cta(
            model, coefficients, fit.faces, budget=budget, vertex_weights=weights
        )
    signal = _signal(coefficients)
    return less_overdraw_cpca(model, signal, fit.faces, budget=budget, vertex_weights=weights)


def factors_of(
    model: CpcaModel | CtaModel, shape: tuple[int, ...], n_channels: int
) -> dict[str, NDArray[Any]]:
    """Name the factors of a model of (verts, rows, coeffs) transfer.

    To a model of signals every term is a view column of its own.
    """
    if isinstance(model, CtaModel):
        names = ("labels", "weights", "ranks", "view_basis", "light_bases", "dual_bases")
        return {name: getattr(model, name) for name in names}
    _, n_rows, n_coeffs = shape
    n_terms = n_rows // n_channels
    ranks = np.empty((model.n_clusters, 3), np.int32)
    ranks[:, 0], ranks[:, 1], ranks[:, 2] = n_terms, n_coeffs, model.ranks
    factors = {name: getattr(model, name) for name in ("labels", "weights", "means", "components")}
    return factors | {"ranks": ranks, "view_basis": np.eye(n_terms, dtype=np.float32)}
