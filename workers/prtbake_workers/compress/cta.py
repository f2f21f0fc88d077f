"""Clustered tensor approximation of a glossy transfer tensor [Tsai2006]_ section 5.2.

Three phases: an initial clustering, a clustering phase that alternates between fitting the bases
of each cluster and re-classifying the vertices, and an approximation phase that also updates the
view basis shared by all clusters.

Transfer of three colour channels is one tensor whose view axis holds the channels one under the
other.  They share the view basis; what it leaves of them, channels * R_view rows, is not reduced
further in that mode, so a vertex's one set of weights serves all colours.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.coherence import Coherence
from prtbake_workers.compress.cta_fit import CtaFit, CtaProblem
from prtbake_workers.compress.cta_model import CtaModel, CtaRanks
from prtbake_workers.compress.cta_schedule import CONVERGED, Schedule, Step
from prtbake_workers.compress.inputs import (
    checked_count,
    checked_rows,
    checked_vertex_weights,
    clipped,
    fitting_clusters,
)
from prtbake_workers.compress.parallel import same_bytes_on_any_threads
from prtbake_workers.compress.progress import Progress, no_progress
from prtbake_workers.compress.rows import Rows

__all__ = ["CtaModel", "CtaRanks", "compress_cta", "cta_problem"]


def compress_cta(
    transfer: NDArray[Any] | Rows,
    n_clusters: int,
    ranks: CtaRanks,
    *,
    seed: int,
    max_iterations: int = 10,
    tolerance: float = CONVERGED,
    vertex_weights: NDArray[Any] | None = None,
    n_channels: int = 1,
    coherence: Coherence | None = None,
    progress: Progress = no_progress,
) -> CtaModel:
    """Approximate a transfer tensor by clusters of vertices with a basis for each mode.

    Parameters
    ----------
    transfer
        float32 T, (verts, rows, coeffs): the (view, light) matrix of each vertex, in an orthonormal
        (whitened) basis of the light and with orthonormal view functions, so that squared errors
        are squared radiance errors.  A row is a term of the view; with channels, row c * terms + k
        is term k of channel c.  Rows that lie outside of memory stay there: each thread reads a
        chunk of vertices, or the members of a cluster, at a time.
    n_clusters
        Clusters, at least 1; cut to the number of vertices.
    ranks
        (view, light, vert) reduced ranks, at least 1; cut to what the tensor's shape can fill.
        The view rank is that of each channel.
    seed
        Start of the clustering; the same seed and tensor give the same model.
    max_iterations
        Most iterations of the clustering phase.
    tolerance
        Both phases end earlier where no vertex moves or an iteration wins less than this share of
        the error.
    vertex_weights
        Weight of each vertex in the squared error, >= 0, e.g. its area; ones when None.  Vertices
        of weight zero are approximated by what serves the others.
    n_channels
        Colour channels that the rows hold one after the other, at least 1.
    coherence
        Lets vertices pay for being far from their cluster on the mesh: the initial clusters are
        coherent, and a vertex moves only where that does not cost it more than it wins.  None for
        the transfer alone.
    progress
        Called with the fraction done and a word on the state, at most once a step.

    Returns
    -------
    CtaModel
        The same bytes on any number of threads, wherever the transfer lies.  Clusters may be fewer
        than asked for where the tensor has too few distinct vertices, and each has its true ranks;
        ``notes`` says so.

    Raises
    ------
    SettingsError
        For what cannot be used, with the argument as pointer and the vertex in the message.
    ObjectiveRose
        Where the squared error rises between model steps by more than 1e-7 of the squared norm.

    Notes
    -----
    A light basis starts from the last iteration's, so the squared error cannot rise.  An empty
    cluster takes a part of the one with the largest error, along with its bases.
    """
    notes: list[str] = []
    problem = cta_problem(
        transfer,
        n_clusters,
        ranks,
        vertex_weights=vertex_weights,
        n_channels=n_channels,
        coherence=coherence,
        notes=notes,
    )
    checked_count(max_iterations, "max_iterations")
    with same_bytes_on_any_threads():
        progress(0.0, "initial clusters")
        fit = CtaFit.started(problem, np.random.default_rng(seed))
        schedule = Schedule(fit.squared_norm, max_iterations, tolerance)
        while (step := schedule.step) is not Step.END:
            _take(step, fit, schedule)
            if step in (Step.MODEL, Step.FIT):
                progress(schedule.fraction, f"{step.value}, error {schedule.trace.ratio:.3%}")
        progress(1.0, f"error {schedule.trace.ratio:.3%}")
        return fit.model(schedule.trace.values, seed, notes)


def _take(step: Step, fit: CtaFit, schedule: Schedule) -> None:
    """Make a step of all clusters and take it."""
    match step:
        case Step.MODEL:
            fit.take_fitted(fit.fitted_clusters(fit.clusters))
            schedule.modelled(fit.objectives(fit.clusters))
        case Step.CLASSIFY:
            schedule.moved(fit.move(fit.better_clusters(fit.clusters)))
        case Step.VIEW:
            parts = fit.view_parts(fit.clusters)
            fit.take_view([part.gram for part in parts], [part.vertex_basis for part in parts])
            fit.project_view()
            schedule.seen()
        case Step.FIT:
            fit.take_fitted(fit.fitted_in_view(fit.clusters))
            schedule.modelled(fit.objectives(fit.clusters))


def cta_problem(
    transfer: NDArray[Any] | Rows,
    n_clusters: int,
    ranks: CtaRanks,
    *,
    vertex_weights: NDArray[Any] | None,
    n_channels: int,
    coherence: Coherence | None,
    notes: list[str],
) -> CtaProblem:
    """Check what `compress_cta` is given, cut it to what fits, and say so in ``notes``."""
    t = checked_rows(transfer, "transfer", ("verts", "terms", "coeffs"))
    n_verts, n_rows, n_coeffs = t.shape
    if n_rows % checked_count(n_channels, "n_channels"):
        raise SettingsError(
            f"transfer has {n_rows} rows for n_channels {n_channels}: no whole terms",
            pointer="/n_channels",
        )
    ranks = CtaRanks(*ranks)
    for name, value in zip(ranks._fields, ranks, strict=True):
        checked_count(value, f"ranks/{name}")
    weights = checked_vertex_weights(vertex_weights, n_verts)
    clusters = fitting_clusters(n_clusters, n_verts, notes)
    n_terms = n_rows // n_channels
    view = clipped(ranks.view, n_terms, "ranks.view", f"{n_terms} terms", notes)
    light = clipped(ranks.light, n_coeffs, "ranks.light", f"{n_coeffs} coefficients", notes)
    span = min(n_verts, n_channels * view * light)
    vert = clipped(ranks.vert, span, "ranks.vert", f"vertices span {span} dimensions", notes)
    return CtaProblem(
        transfer=t,
        weights=weights,
        ranks=CtaRanks(view, light, vert),
        n_clusters=clusters,
        n_channels=n_channels,
        coherence=coherence,
    )
