"""Write ``asset.h5``: factors rounded as the settings ask, the error measured in the file."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.decode.asset import Asset, Part
from prtbake_storage.decode.quantise import Scales, peak_scales
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import TransferFile
from prtbake_storage.hdf5.writer import write_asset
from prtbake_workers.arrays import F64
from prtbake_workers.compress.bit_allocation import allocate_bits, measured
from prtbake_workers.compress.rounding_error import RoundingError, rounding_error

SHARE = 0.01
"""Of what compression leaves, that rounding may add where the settings give no bound."""

NOTED_SHARE = 0.1
"""Of what compression leaves: rounding that adds more is worth a note."""


class Rounded(NamedTuple):
    """The asset as readers see it; squared-error ratios by part, and notes."""

    asset: Asset
    errors: dict[str, float]
    notes: list[str]


def options(settings: CompressSettings) -> dict[str, Any]:
    """Return what `write_rounded` needs of the settings, as JSON."""
    return {"bits": settings.bits, "max_quantisation_error": settings.max_quantisation_error}


def write_rounded(
    path: Path,
    exact: Asset,
    transfer: TransferFile,
    rounding: dict[str, Any],
    left: list[float],
    allowed: list[float] | None = None,
) -> Rounded:
    """Write the asset with rounded factors.

    Parameters
    ----------
    rounding
        As `options` gives it.
    left
        Squared-error ratio of each part's compression.
    allowed
        Squared error that rounding may add to each part, weighted by area, where the settings do
        not bound it; a hundredth of what is left when None.

    Raises
    ------
    SettingsError
        No 16 bits meet the bound that was given; says what they leave.
    """
    areas = [part.areas for part in transfer.header.parts]
    energies = [energy_of(transfer, index) for index in range(len(areas))]
    if allowed is None:
        allowed = [SHARE * share * energy for share, energy in zip(left, energies, strict=True)]
    chosen = [
        _scales(part, own, energy, rounding, default)
        for part, own, energy, default in zip(exact.parts, areas, energies, allowed, strict=True)
    ]
    scales = [own for own, _ in chosen]
    totals = [error.total for _, error in chosen]
    return _written(path, exact, transfer, scales, totals, rounding, left)


def write_scaled(
    path: Path,
    exact: Asset,
    transfer: TransferFile,
    scales: Sequence[Scales],
    rounding: dict[str, Any],
    left: list[float],
) -> Rounded:
    """Write the asset with factors rounded by scales that are given, as `write_rounded` does."""
    totals = [
        measured(part, own, transfer.header.parts[index].areas).total
        for index, (part, own) in enumerate(zip(exact.parts, scales, strict=True))
    ]
    return _written(path, exact, transfer, scales, totals, rounding, left)


def _written(
    path: Path,
    exact: Asset,
    transfer: TransferFile,
    scales: Sequence[Scales],
    totals: Sequence[float],
    rounding: dict[str, Any],
    left: list[float],
) -> Rounded:
    """Write the file with the error of every part in it, and read it back."""
    energies = [energy_of(transfer, index) for index in range(len(totals))]
    ratios = [_ratio(total, energy) for total, energy in zip(totals, energies, strict=True)]
    write_asset(path, exact, bits=list(scales), errors=ratios)
    areas = [part.areas for part in transfer.header.parts]
    return _as_read(path, exact, areas, energies, rounding, left)


def energy_of(transfer: TransferFile, part: int) -> float:
    """Return the squared norm of a part's transfer by area, less what projection left."""
    found = transfer.energies(part)
    areas = transfer.header.parts[part].areas
    return float(areas @ np.maximum(found.signal - found.residual, 0.0))


def _as_read(
    path: Path,
    exact: Asset,
    areas: list[F64],
    energies: list[float],
    rounding: dict[str, Any],
    left: list[float],
) -> Rounded:
    """Read the file back and hold it against the exact factors and the bound."""
    seen = read_asset(path)
    errors: dict[str, float] = {}
    notes: list[str] = []
    for before, after, own, energy, share in zip(
        exact.parts, seen.parts, areas, energies, left, strict=True
    ):
        error = rounding_error(before, after, own)
        check_stated(after, error, energy, rounding["max_quantisation_error"])
        errors[before.name] = _ratio(error.factors, energy)
        if before.view_texture is not None:
            errors[f"{before.name} view texture's rounding"] = _ratio(error.texture, energy)
        added = _ratio(error.total, energy)
        if rounding["bits"] != "auto" and added > NOTED_SHARE * share:
            notes.append(
                f"{before.name}: {rounding['bits']} bits add {added:.2g} (squared, relative) to "
                f"the {share:.2g} that compression leaves: bits 'auto' would add less"
            )
    return Rounded(seen, errors, notes)


def check_stated(part: Part, error: RoundingError, energy: float, bound: float | None) -> None:
    """Hold a part that was read against what its file says of it and against the bound.

    Raises
    ------
    RuntimeError
        The file says another error, or one above the bound: neither happens unless a routine here
        is wrong.
    """
    ratio = _ratio(error.total, energy)
    stated = None if part.precision is None else part.precision.error
    if stated is None or not np.isclose(ratio, stated, rtol=1e-9, atol=0.0):
        raise RuntimeError(f"{part.name}: rounding adds {ratio}, and the file says {stated}")
    if bound is not None and ratio > bound:
        raise RuntimeError(f"{part.name}: rounding adds {ratio}, above the bound of {bound}")


def _scales(
    part: Part, areas: F64, energy: float, rounding: dict[str, Any], default: float
) -> tuple[Scales, RoundingError]:
    """Choose the scales of a part by its bits or its bound; also the error they leave."""
    if rounding["bits"] != "auto" or energy == 0.0:
        scales = peak_scales(part, 16 if rounding["bits"] == "auto" else rounding["bits"])
        return scales, measured(part, scales, areas)
    given = rounding["max_quantisation_error"]
    allocation = allocate_bits(part, areas, default if given is None else given * energy)
    if allocation.meets or given is None:
        # without a bound of its own, a part that compression fits as closely as 16 bits has these
        return allocation.scales, allocation.error
    least = _ratio(allocation.error.total, energy)
    raise SettingsError(
        f"max_quantisation_error is {given:g}: 16 bits add {least:.3g} to part {part.name!r}, and "
        "no asset has more",
        pointer="/settings/compress/max_quantisation_error",
    )


def _ratio(error: float, energy: float) -> float:
    return error / energy if energy > 0.0 else 0.0
