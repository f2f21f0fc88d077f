"""Vector quantisation of transfer: each vertex has the mean of its cluster.

It is clustered PCA ([Sloan2003]_ section 4) without components.  No vertex has weights of its own,
so that files and pictures cost what the means cost.
"""

from functools import partial
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.coherence import Coherence
from prtbake_workers.compress.cpca_model import CpcaModel
from prtbake_workers.compress.elbg import shift_clusters
from prtbake_workers.compress.energy import row_energy_by_chunks
from prtbake_workers.compress.inputs import (
    checked_count,
    checked_signal,
    checked_vertex_weights,
    fitting_clusters,
)
from prtbake_workers.compress.lbg import Start, lbg
from prtbake_workers.compress.parallel import same_bytes_on_any_threads
from prtbake_workers.compress.progress import Progress, no_progress

Known = TypeVar("Known", bound=str)
Method = Literal["lbg", "elbg"]
METHODS: tuple[Method, ...] = ("lbg", "elbg")
STARTS: tuple[Start, ...] = ("hyper_box", "spread")


def compress_vq(
    signal: Float[NDArray[Any], "verts dims"],
    n_clusters: int,
    *,
    start: str = "hyper_box",
    method: str = "lbg",
    seed: int,
    max_iterations: int = 40,
    vertex_weights: NDArray[Any] | None = None,
    coherence: Coherence | None = None,
    progress: Progress = no_progress,
) -> CpcaModel:
    """Approximate each row of ``signal`` by the mean of its cluster.

    Parameters
    ----------
    signal
        float32 coefficients of each vertex in an orthonormal (whitened) basis, so that squared
        errors are squared radiance errors.
    n_clusters
        Clusters, at least 1; cut to the number of vertices.
    start
        Where the means are first: ``hyper_box``, anywhere in the signal's box ([Chen2005]_ section
        3.1.2), or ``spread``, at vertices that are far from each other [Arthur2007]_.
    method
        ``lbg`` [Linde1980]_, or ``elbg`` [Patane2001]_, which ends in better minima.
    seed
        Of the start and of the shifts; the same seed and signal give the same bytes on any number
        of threads.
    max_iterations
        Most iterations, at least 1.
    vertex_weights
        Weight of each vertex in means and squared error, >= 0, e.g. its area; ones when None.
    coherence
        Lets vertices pay for being far from their cluster on the mesh; None for the signal alone.
    progress
        Called with the fraction done and a word on the state, once an iteration.

    Returns
    -------
    CpcaModel
        With no components and no weights.  Clusters may be fewer than asked for where the signal
        has too few distinct vertices; ``notes`` says so.

    Raises
    ------
    SettingsError
        For what cannot be used, with the argument as pointer and the vertex in the message.
    ObjectiveRose
        Where an iteration raises the squared error by more than 1e-7 of the squared norm.
    """
    first, shifts = _one_of(STARTS, start, "start"), _one_of(METHODS, method, "method") == "elbg"
    x = checked_signal(signal, "signal", ("verts", "dims"))
    weights = checked_vertex_weights(vertex_weights, len(x))
    notes: list[str] = []
    n_clusters = fitting_clusters(n_clusters, len(x), notes)
    checked_count(max_iterations, "max_iterations")
    rng = np.random.default_rng(seed)
    with same_bytes_on_any_threads():
        progress(0.0, "initial clusters")
        clusters = lbg(
            x,
            n_clusters,
            rng=rng,
            weights=weights,
            max_iterations=max_iterations,
            start=first,
            coherence=coherence,
            improve=partial(shift_clusters, rng=rng) if shifts else None,
            progress=progress,
        )
        energy = float(weights @ row_energy_by_chunks(x))
    used, labels = np.unique(clusters.labels, return_inverse=True)
    if len(used) < n_clusters:
        notes.append(f"{n_clusters - len(used)} clusters left out: too few distinct vertices")
    error = clusters.objective[-1] / energy if energy > 0.0 else 0.0
    progress(1.0, f"error {error:.3%}")
    return CpcaModel(
        means=clusters.means[used],
        components=np.zeros((len(used), 0, x.shape[1]), np.float32),
        weights=np.zeros((len(x), 0), np.float32),
        labels=labels.astype(np.int32),
        ranks=np.zeros(len(used), np.int32),
        objective=clusters.objective,
        initial_energy=energy,
        squared_error_per_vertex=clusters.squared_distances,
        iterations=len(clusters.objective),
        seed=seed,
        notes=notes,
    )


def _one_of(known: tuple[Known, ...], value: str, name: str) -> Known:
    for one in known:
        if one == value:
            return one
    raise SettingsError(
        f"VQ {name} {value!r} is not available; use {', '.join(map(repr, known))}",
        pointer=f"/{name}",
    )
