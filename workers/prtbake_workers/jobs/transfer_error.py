"""How far an asset is from the transfer that it was compressed from."""

from typing import Any

import numpy as np

from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Task
from prtbake_workers.arrays import F32, F64

_MODULE = "prtbake_workers.jobs.transfer_error"
READ_VERTS = 1024
"""Vertices compared at a time: the stored, the decoded and their difference lie side by side."""


def task(transfer: str, asset: str) -> Task:
    """Compare two files, named by their digests."""
    return Task(f"{_MODULE}:measure", {"transfer": transfer, "asset": asset}, label="error")


def measure(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: the squared-error ratio of all that is decoded, over all vertices by their area.

    Returns
    -------
    dict
        ``error``, that of all parts together, and ``parts``, each against its own signal; 0 where
        there is no signal.
    """
    asset = read_asset(context.store.local_path(args["asset"]))
    errors: list[float] = []
    signals: list[float] = []
    with open_transfer(context.store.local_path(args["transfer"])) as transfer:
        parts = transfer.header.parts
        for index, (stored, own) in enumerate(zip(parts, asset.parts, strict=True)):
            error = signal = 0.0
            for start in range(0, stored.n_vertices, READ_VERTS):
                stop = min(start + READ_VERTS, stored.n_vertices)
                expected = transfer.read(index, start, stop)
                difference = reconstruct(own, slice(start, stop)) - expected
                areas = stored.areas[start:stop]
                signal += _energy(expected, areas)
                error += _energy(difference, areas)
            errors.append(error)
            signals.append(signal)
            context.progress(index + 1, len(parts), "parts")
    return {
        "error": _ratio(sum(errors), sum(signals)),
        "parts": {
            part.name: _ratio(error, signal)
            for part, error, signal in zip(parts, errors, signals, strict=True)
        },
    }


def _energy(values: F32, areas: F64) -> float:
    return float(areas @ (values.astype(np.float64) ** 2).sum(axis=(1, 2)))


def _ratio(error: float, signal: float) -> float:
    return error / signal if signal else 0.0
