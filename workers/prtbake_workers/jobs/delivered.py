"""Write ``asset.h5`` and measure it, as it is delivered, against the transfer it was made from."""

from pathlib import Path
from typing import Any

import numpy as np

from prtbake_storage.decode.asset import Asset, Part
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.hdf5.transfer import TransferFile
from prtbake_workers.jobs.rounding import Rounded, write_rounded

READ_VERTS = 2048
"""Vertices at a time."""

ROOM = 0.995
"""Of an error that is asked for, to be filled: errors of compression and rounding add up where they
are independent, which holds to the root of how many numbers were rounded."""

ROUNDING_TRIES = (1.0, 0.5, 0.0)
"""Shares of what is left for rounding, until the file keeps to the error."""


def write_delivered(
    path: Path, exact: Asset, transfer: TransferFile, args: dict[str, Any]
) -> tuple[Rounded, dict[str, Any]]:
    """Write the rounded asset; where an error is asked for, let rounding fill what is left of it.

    Parameters
    ----------
    args
        ``rounding`` as `prtbake_workers.jobs.rounding.options` gives it, ``max_error`` or None, and
        of every part's compression ``left``, its squared-error ratio, and ``energies``, the
        transfer's squared norm with weights that sum to 1.

    Returns
    -------
    Rounded, dict
        The asset as it reads, and its squared-error ratios: ``error`` of all parts together, and
        ``parts``, of each by its name; 0 where there is no transfer.

    Raises
    ------
    RuntimeError
        A part errs by more than what was asked for: a routine is wrong.
    """
    asked, left = args["max_error"], args["left"]
    for share in (1.0,) if asked is None else ROUNDING_TRIES:
        allowed = None
        if asked is not None:
            allowed = [
                share * max(ROOM * asked - own, 0.0) * energy * float(part.areas.sum())
                for own, energy, part in zip(
                    left, args["energies"], transfer.header.parts, strict=True
                )
            ]
        rounded = write_rounded(path, exact, transfer, args["rounding"], left, allowed)
        delivered = delivered_errors(transfer, rounded.asset)
        over = {
            name: error for name, error in delivered["parts"].items() if asked and error > asked
        }
        if not over:
            return rounded, delivered
    name, error = next(iter(over.items()))
    raise RuntimeError(f"{name} errs by {error}, above the {asked} that was asked for")


def delivered_errors(transfer: TransferFile, asset: Asset) -> dict[str, Any]:
    """Measure the squared-error ratios of an asset's factors, weighted by area, as above.

    Parameters
    ----------
    transfer
        An open file.
    asset
        As readers see it.
    """
    found = [_squares(transfer, index, part) for index, part in enumerate(asset.parts)]
    errors, energies = zip(*found, strict=True)
    return {
        "error": _ratio(sum(errors), sum(energies)),
        "parts": {
            part.name: _ratio(error, energy)
            for part, (error, energy) in zip(asset.parts, found, strict=True)
        },
    }


def _squares(transfer: TransferFile, index: int, part: Part) -> tuple[float, float]:
    """Sum the squared error and the squared norm of a part's transfer by area."""
    areas = transfer.header.parts[index].areas
    error = energy = 0.0
    for start in range(0, part.n_vertices, READ_VERTS):
        verts = slice(start, min(start + READ_VERTS, part.n_vertices))
        rows = transfer.read(index, verts.start, verts.stop)
        difference = reconstruct(part, verts) - rows
        error += float(areas[verts] @ np.square(difference, dtype=np.float64).sum(axis=(1, 2)))
        energy += float(areas[verts] @ np.square(rows, dtype=np.float64).sum(axis=(1, 2)))
    return error, energy


def _ratio(error: float, energy: float) -> float:
    return error / energy if energy > 0.0 else 0.0
