"""What every way of compressing a part is given, and what it says of it."""

from pathlib import Path
from typing import Any

import numpy as np

from prtbake_storage.decode.overdraw import average_overdraw
from prtbake_storage.hdf5.bundle import write_bundle
from prtbake_storage.hdf5.transfer import TransferPart, open_transfer
from prtbake_storage.queue.context import TaskContext
from prtbake_workers.arrays import F64, I32
from prtbake_workers.compress.coherence import coherence_of
from prtbake_workers.compress.methods import Compressed, Fit
from prtbake_workers.compress.superclusters import check_registers, registers_of_clusters


def read_mesh(path: Path, part: TransferPart) -> tuple[F64, I32]:
    """Read a part's positions (verts, 3), and triangles (tris, 3) in its own numbering."""
    with open_transfer(path) as transfer:
        header = transfer.header
    start, stop = part.vertex_range
    own = (header.faces[:, 0] >= start) & (header.faces[:, 0] < stop)
    return header.positions[start:stop], header.faces[own] - np.int32(start)


def part_weights(part: TransferPart) -> F64 | None:
    """Return the share of each vertex in the part's area (verts,); None for a part without any."""
    whole = part.areas.sum()
    return part.areas / whole if whole > 0 else None


def part_fit(
    args: dict[str, Any], context: TaskContext, part: TransferPart, classification: str
) -> tuple[Fit, I32]:
    """Say how a part is fitted, its vertices weighted by area; also its triangles."""
    draws = args.get("draws") or {}
    positions, faces = read_mesh(context.store.local_path(args["transfer"]), part)

    def progress(fraction: float, phase: str) -> None:
        context.progress(fraction, 1.0, phase)

    fit = Fit(
        seed=args["seed"],
        max_iterations=args["max_iterations"],
        n_channels=part.n_channels,
        vertex_weights=part_weights(part),
        classification=classification,
        coherence=coherence_of(positions, draws.get("coherence")),
        faces=faces,
        overdraw_budget=draws.get("overdraw_budget"),
        progress=progress,
    )
    return fit, faces


def part_result(
    compressed: Compressed,
    part: TransferPart,
    transfer_bytes: int,
    faces: I32,
    args: dict[str, Any],
    context: TaskContext,
) -> dict[str, Any]:
    """Store a part's factors; return the result of a task that made them."""
    model, method = compressed.model, args["compression"]["method"]
    registers = (args.get("draws") or {}).get("registers")
    # factors for a number of bytes are ample: what stays of them is held against registers later
    if registers is not None and args.get("max_bytes") is None:
        # planning knows neither ranks that are searched nor those of adaptive classification
        with_mean = "means" in compressed.factors
        needs = registers_of_clusters(compressed.factors["ranks"], with_mean=with_mean)
        check_registers(needs, registers)
    path = write_bundle(context.scratch / "factors.h5", compressed.factors, {"method": method})
    return {
        "factors": context.store.put_file(path, move=True),
        "name": part.name,
        "method": method,
        "clusters": int(model.n_clusters),
        "objective": [float(value) for value in model.objective],
        "initial_energy": float(model.initial_energy),
        "iterations": int(model.iterations),
        "factor_bytes": int(model.nbytes),
        "transfer_bytes": transfer_bytes,
        "errors": {part.name: float(model.squared_error_ratio)},
        "overdraw": average_overdraw(faces, model.labels),
        "notes": list(model.notes),
    }
