"""Tasks of a tensor approximation whose steps are shared: start, four kinds of steps, finish.

Clusters are the tiles.  The vertices that a classification takes are blocks of clusters too: their
products are then those of a fit in one task, and the asset is the same, byte by byte.
"""

from typing import Any

import numpy as np

from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.hdf5.transfer import TransferPart, open_transfer
from prtbake_storage.queue.context import TaskContext
from prtbake_workers.arrays import F64
from prtbake_workers.compress.coherence import coherence_of
from prtbake_workers.compress.cta import cta_problem
from prtbake_workers.compress.cta_fit import CtaFit
from prtbake_workers.compress.cta_model import CtaRanks
from prtbake_workers.compress.methods import finished
from prtbake_workers.compress.parallel import same_bytes_on_any_threads
from prtbake_workers.jobs import cta_state
from prtbake_workers.jobs.part_fit import part_fit, part_result, part_weights, read_mesh
from prtbake_workers.jobs.pointing import pointing_at
from prtbake_workers.jobs.rows_file import write_rows


@pointing_at(CompressSettings)
def start(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: project on the view's leading vectors, and cluster what that gives."""
    path = context.store.local_path(args["transfer"])
    rows_path = context.scratch / "part.rows"
    with open_transfer(path) as transfer:
        part = transfer.header.parts[args["part"]]
        rows = write_rows(rows_path, transfer, args["part"])
    positions, _ = read_mesh(path, part)
    compression = args["compression"]
    notes: list[str] = []
    problem = cta_problem(
        rows,
        compression["n_clusters"],
        CtaRanks(*compression["ranks"]),
        vertex_weights=part_weights(part),
        n_channels=part.n_channels,
        coherence=coherence_of(positions, args["draws"].get("coherence")),
        notes=notes,
    )
    with same_bytes_on_any_threads():
        fit = CtaFit.started(problem, np.random.default_rng(args["seed"]))
    state = cta_state.write_start(context.scratch / "start.h5", fit, rows)
    return {
        "rows": context.store.put_file(rows_path, move=True),
        "state": context.store.put_file(state, move=True),
        "n_clusters": problem.n_clusters,
        "ranks": list(problem.ranks),
        "squared_norm": fit.squared_norm,
        "notes": notes,
    }


def model(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: move whom the classification before found, then fit the bases of some clusters."""
    fit = _fit(args, context)
    with same_bytes_on_any_threads():
        if args["moves"]:
            fit.move(cta_state.read_moves(context.store, args["moves"]))
        return _fitted(fit, fit.fitted_clusters(range(*args["clusters"])), args, context)


def classify(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: find who leaves some clusters."""
    fit = _fit(args, context)
    with same_bytes_on_any_threads():
        moves = fit.better_clusters(range(*args["clusters"]))
    path = cta_state.write_moves(context.scratch / "moves.h5", moves)
    return {
        "moves": context.store.put_file(path, move=True),
        "moved": sum(len(own.verts) for own in moves),
    }


def view(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: sum what some clusters say about the view basis."""
    fit = _fit(args, context)
    with same_bytes_on_any_threads():
        parts = fit.view_parts(range(*args["clusters"]))
    path = cta_state.write_view(context.scratch / "view.h5", parts)
    return {"view": context.store.put_file(path, move=True)}


def approximate(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: take the new view basis, and fit the other bases of some clusters in it."""
    fit = _fit(args, context)
    clusters = range(*args["clusters"])
    with same_bytes_on_any_threads():
        fit.take_view(*cta_state.read_view(context.store, args["views"]))
        members = fit.members()
        for cluster in clusters:
            verts = members[cluster]
            fit.view_errors[verts] = fit.view_errors_of(verts)
        return _fitted(fit, fit.fitted_in_view(clusters), args, context)


@pointing_at(CompressSettings)
def finish(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: join the clusters to the part's factors, as a fit in one task leaves them."""
    fit = _fit(args, context)
    transfer, part = fit.problem.transfer, _part(args, context)
    with same_bytes_on_any_threads():
        made = fit.model(args["objective"], args["seed"], list(args["started"]["notes"]))
    own, faces = part_fit(args, context, part, args["compression"]["classification"])
    compressed = finished(made, transfer, own)
    return part_result(compressed, part, transfer.nbytes, faces, args, context)


def _part(args: dict[str, Any], context: TaskContext) -> TransferPart:
    with open_transfer(context.store.local_path(args["transfer"])) as transfer:
        parts: tuple[TransferPart, ...] = transfer.header.parts
    return parts[int(args["part"])]


def _fit(args: dict[str, Any], context: TaskContext) -> CtaFit:
    """Read the state that a step begins from."""
    part = _part(args, context)
    weights = part_weights(part)
    positions, _ = read_mesh(context.store.local_path(args["transfer"]), part)
    ones: F64 = np.ones(part.n_vertices)
    return cta_state.read_fit(
        context.store,
        cta_state.Started.from_dict(args["started"]),
        args["models"],
        part,
        weights=ones if weights is None else weights,
        coherence=coherence_of(positions, args["draws"].get("coherence")),
    )


def _fitted(
    fit: CtaFit, fitted: list[Any], args: dict[str, Any], context: TaskContext
) -> dict[str, Any]:
    """Write some clusters after a model step, and say what error they leave."""
    clusters = range(*args["clusters"])
    members = fit.members()
    for cluster, (_, errors) in zip(clusters, fitted, strict=True):
        fit.errors[members[cluster]] = errors
    path = cta_state.write_model(context.scratch / "model.h5", fit, clusters, fitted)
    return {
        "model": context.store.put_file(path, move=True),
        "objectives": fit.objectives(clusters),
    }
