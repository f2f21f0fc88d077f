"""Write ``asset.h5`` to a number of bytes that is asked for: never above it, and just below.

One distortion of every number decides which columns stay and how they are rounded
(`prtbake_workers.compress.at_price`).  It is searched by writing the file to memory, so that mesh,
tables and gzip count as they are.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import exp, log
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from prtbake_storage.decode.asset import Asset, Part
from prtbake_storage.decode.quantise import Scales
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.transfer import TransferFile
from prtbake_storage.hdf5.writer import asset_size
from prtbake_workers.arrays import F64
from prtbake_workers.compress.at_price import at_distortion
from prtbake_workers.jobs.delivered import delivered_errors, write_delivered
from prtbake_workers.jobs.rounding import Rounded, energy_of, write_scaled

NEAR = 0.98
"""Of what mesh, tables and labels leave of the bytes, that a file has to fill at least."""

LEAST = 0.9
"""Of them: a file below this share is worth a note."""

MOST_TRIES = 24
"""Distortions tried."""

FIRST = 1e-8
"""Distortion that is tried first, over the energy of all light."""

STRIDE = log(64.0)
"""Of the distortion's logarithm, while sizes lie on one side of what is asked for only."""

UNDRAWN = 2**62
"""Stands for the bytes of a file whose clusters take more registers than there are."""

COARSEST, FINEST = 1e3, 1e-24
"""Beyond which no column stays, and no number has fewer than 16 bits."""


class Sized(NamedTuple):
    """The asset with what stays of its factors, exact, and what was written of it.

    Attributes
    ----------
    exact
        Float32 factors, without the columns that were left out.
    rounded
        The asset as it reads; its ``errors`` tell what leaving columns out added, too.
    delivered
        As `prtbake_workers.jobs.delivered.write_delivered` gives them.
    """

    exact: Asset
    rounded: Rounded
    delivered: dict[str, Any]


@dataclass(frozen=True)
class _Try:
    distortion: float
    parts: tuple[Part, ...]
    scales: list[Scales]
    size: int


def write_asked(
    path: Path,
    whole: Asset,
    transfer: TransferFile,
    args: dict[str, Any],
    finished: Callable[[Asset], Asset],
) -> Sized:
    """Write the asset with the bits, to the error or to the bytes that are asked for.

    Parameters
    ----------
    path, whole, transfer, finished
        As of `write_sized`.
    args
        ``max_bytes``, ``max_error``, and ``held_to``, bytes that a file of neither is cut to where
        it takes more; each may be None.  ``left``, ``energies`` and ``rounding`` as of
        `write_delivered`.

    Raises
    ------
    SettingsError
        The bytes are too few.
    """
    asked, held_to, by_error = args.get("max_bytes"), args.get("held_to"), args["max_error"]
    if asked is not None and by_error is None:
        return write_sized(path, whole, transfer, args, finished)
    exact = finished(whole)
    rounded, delivered = write_delivered(path, exact, transfer, args)
    if held_to is not None:
        args = args | {"max_bytes": held_to}
        if by_error is None and path.stat().st_size > held_to:
            return write_sized(path, whole, transfer, args, finished)
    check_bytes(path, args)
    return Sized(exact, rounded, delivered)


def write_sized(
    path: Path,
    exact: Asset,
    transfer: TransferFile,
    args: dict[str, Any],
    finished: Callable[[Asset], Asset] = lambda asset: asset,
) -> Sized:
    """Write the asset with the least error found for its bytes.

    The squared error of each part is weighed by area, over the transfer of all parts of its role.
    The bytes go where they take most off the sum: among parts of the object by what these have in
    pictures, while a receiver that is large and bright does not take what the object needs.

    Parameters
    ----------
    path
        Of the file.
    exact
        Ample factors.
    transfer
        That they were made from.
    args
        ``max_bytes``, and ``left`` and ``rounding`` as of `write_delivered`.
    finished
        Adds what goes by the ranks that stay, to the asset that is written.

    Raises
    ------
    SettingsError
        Mesh and tables alone take more, and tells the least; or ``finished`` refuses whatever is
        left out.
    """
    asked = args["max_bytes"]
    areas = relative_areas(transfer)

    def tried_at(distortion: float) -> _Try:
        found = [at_distortion(p, a, distortion) for p, a in zip(exact.parts, areas, strict=True)]
        parts, scales = tuple(part for part, _ in found), [own for _, own in found]
        try:
            asset = finished(replace(exact, parts=parts))
        except SettingsError:
            if distortion >= COARSEST:
                raise
            return _Try(distortion, parts, scales, UNDRAWN)  # fewer columns take fewer registers
        size = asset_size(asset, bits=scales, errors=[0.0] * len(parts))
        return _Try(distortion, asset.parts, scales, size)

    least = tried_at(COARSEST)
    aim, size = asked, asked + 1
    while size > asked:
        if least.size > aim:
            raise SettingsError(
                f"max_bytes is {asked}: mesh, tables and labels alone take {least.size}",
                pointer="/settings/compress/max_bytes",
            )
        best = _largest_below(tried_at, aim, least)
        kept = replace(exact, parts=best.parts)
        rounded = write_scaled(path, kept, transfer, best.scales, args["rounding"], args["left"])
        size = path.stat().st_size
        # the file on disk is what counts, whatever memory foretells
        aim = best.size - (size - asked)
    lost = _left_out(transfer, kept, args["left"])
    delivered = delivered_errors(transfer, rounded.asset)
    note = _in_words(asked, size, best.distortion, delivered["parts"])
    told = rounded._replace(errors=rounded.errors | lost, notes=[*rounded.notes, note])
    return Sized(kept, told, delivered)


def check_bytes(path: Path, args: dict[str, Any]) -> None:
    """Refuse a file that met ``max_error`` in more bytes than it may take."""
    asked, size = args.get("max_bytes"), path.stat().st_size
    if asked is not None and size > asked:
        raise SettingsError(
            f"max_bytes is {asked}: max_error {args['max_error']:g} took {size}",
            pointer="/settings/compress/max_bytes",
        )


def relative_areas(transfer: TransferFile) -> list[F64]:
    """Give each part's areas over the energy that all parts of its role hold; zeros where none."""
    parts = transfer.header.parts
    energies: dict[str, float] = {}
    for index, part in enumerate(parts):
        energies[part.role] = energies.get(part.role, 0.0) + energy_of(transfer, index)
    return [
        part.areas / energies[part.role] if energies[part.role] > 0.0 else np.zeros(len(part.areas))
        for part in parts
    ]


def _largest_below(tried_at: Callable[[float], _Try], aim: int, least: _Try) -> _Try:
    """Search the distortion: sizes fall as it grows, about by its logarithm."""
    spare = (1.0 - NEAR) * (aim - least.size)
    best: _Try | None = None
    above: _Try | None = None
    place = log(FIRST)
    for _ in range(MOST_TRIES):
        tried = tried_at(exp(place))
        if tried.size <= aim:
            if best is None or (tried.size, -tried.distortion) > (best.size, -best.distortion):
                best = tried
            if tried.size >= aim - spare or place <= log(FINEST):
                break
        else:
            above = tried
            if place >= log(COARSEST):
                break
        if best is None or above is None:
            stride = STRIDE if tried.size > aim else -STRIDE
            place = min(log(COARSEST), max(log(FINEST), place + stride))
            continue
        coarse, fine = log(best.distortion), log(above.distortion)
        if coarse - fine < 1e-3:
            break
        # between the two, by size, and never close to either: sizes go in steps of columns
        share = (aim - 0.5 * spare - best.size) / (above.size - best.size)
        share = 0.5 if above.size == UNDRAWN else share
        place = coarse + min(0.9, max(0.1, share)) * (fine - coarse)
    return best or least


def _left_out(transfer: TransferFile, kept: Asset, left: Sequence[float]) -> dict[str, float]:
    """Measure what leaving columns out added to each part's squared-error ratio."""
    now = delivered_errors(transfer, kept)["parts"]
    return {
        f"{part.name} left out for its bytes": max(0.0, now[part.name] - before)
        for part, before in zip(kept.parts, left, strict=True)
    }


def _in_words(asked: int, size: int, distortion: float, errors: dict[str, float]) -> str:
    """Say what the bytes bought, and why they are fewer than asked for where they are."""
    of_parts = ", ".join(f"{name} {error:.2g}" for name, error in errors.items())
    words = f"asset.h5 takes {size} of {asked} bytes; squared error, relative: {of_parts}"
    if size < LEAST * asked and distortion <= 2.0 * FINEST:
        words += "; all that there is in 16 bits a number takes no more"
    return words
