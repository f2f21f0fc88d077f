"""Principal component analysis of transfer: clustered PCA ([Sloan2003]_) with one cluster."""

from typing import Any

from jaxtyping import Float
from numpy.typing import NDArray

from prtbake_workers.compress.cpca import compress_cpca
from prtbake_workers.compress.cpca_model import CpcaModel
from prtbake_workers.compress.progress import Progress, no_progress


def compress_pca(
    signal: Float[NDArray[Any], "verts dims"],
    n_components: int,
    *,
    seed: int,
    vertex_weights: NDArray[Any] | None = None,
    progress: Progress = no_progress,
) -> CpcaModel:
    """Approximate each row of ``signal`` by the mean of all and its principal components.

    Parameters
    ----------
    signal
        float32 coefficients of each vertex in an orthonormal (whitened) basis, so that squared
        errors are squared radiance errors.
    n_components
        At least 1; cut to what the signal can fill.
    seed
        Kept in the model; there is nothing to draw.
    vertex_weights
        Weight of each vertex in mean and squared error, >= 0, e.g. its area; ones when None.
    progress
        Called with the fraction done and a word on the state.

    Returns
    -------
    CpcaModel
        With one cluster.  The error is the least that so many components can have.

    Raises
    ------
    SettingsError
        For what cannot be used, with the argument as pointer and the vertex in the message.
    """
    return compress_cpca(
        signal,
        1,
        n_components,
        seed=seed,
        max_iterations=1,
        vertex_weights=vertex_weights,
        progress=progress,
    )
