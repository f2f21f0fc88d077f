"""Scattered measurements of isotropic BRDFs as text: spectral (.brdf) and ALTA (.dat)."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import B8, F64, Bool, Float64
from prtbake_workers.brdf.spectral_colour import rgb_weights

MAX_TEXT_BYTES = 32 << 20
MAX_WAVELENGTHS = 1000
MAX_VALUE = 1e9
"""Largest BRDF taken, in 1/sr."""

MIN_COSINE = 0.01
"""Samples within 0.6 degrees of the horizon are left out: a stored rho cos_o says nothing there."""

ALTA_INPUT = "ISOTROPIC_TL_TV_PROJ_DPHI"
ALTA_OUTPUTS = {"INV_STERADIAN": False, "INV_STERADIAN_COSINE_FACTOR": True}
"""What the values of an ALTA file may be, and whether they hold the cosine of the view."""

_HEADER = re.compile(r"#\s*([A-Z_]+)\s+(.*)")


@dataclass(frozen=True, eq=False)
class ScatteredSamples:
    """Samples of a BRDF at pairs of directions, linear Rec.709, in 1/sr, at least 0.

    ``facts`` tells what the file held and what was left out.
    """

    wi: Float64[F64, "samples 3"]
    wo: Float64[F64, "samples 3"]
    values: Float64[F64, "samples 3"]
    facts: dict[str, Any]


def is_scattered_text(data: bytes) -> bool:
    """Tell whether the bytes are text that begins with a comment or a number."""
    head = data[:4096]
    return head.isascii() and re.match(rb"\s*[#\d]", head) is not None and b"\0" not in head


def read_scattered_text(data: bytes) -> ScatteredSamples:
    """Read either format; ALTA's is known by its header.

    Spectral: count of wavelengths, the wavelengths in nm, then rows of theta_i, phi_i, theta_o,
    phi_o in radians and a value in 1/sr for each wavelength.  ALTA: theta_i, theta_o cos dphi,
    theta_o sin dphi, and one value or three.

    Raises
    ------
    BrdfError
        Names line or row of what is no number, no direction, or not there.
    """
    if len(data) > MAX_TEXT_BYTES:
        raise BrdfError(f"a scattered measurement has at most {MAX_TEXT_BYTES} bytes")
    try:
        lines = data.decode("ascii").splitlines()
    except UnicodeDecodeError as error:
        raise BrdfError(f"the measurement is no plain text: {error.reason}") from error
    header = {match[1]: match[2].strip() for line in lines if (match := _HEADER.match(line))}
    numbers = _numbers(lines)
    if "PARAM_IN" in header or "DIM" in header:
        return _alta(numbers, header)
    return _spectral(numbers)


def _numbers(lines: Sequence[str]) -> Float64[F64, " n"]:
    """Read all numbers outside comments; what is none is named with its line."""
    words = [line.partition("#")[0].split() for line in lines]
    try:
        return np.array([word for line in words for word in line], np.float64)
    except ValueError:
        for number, line in enumerate(words, start=1):
            for word in line:
                if not _is_number(word):
                    raise BrdfError(f"line {number}: {word[:40]!r} is no number") from None
        raise


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _rows(numbers: Float64[F64, " n"], width: int) -> Float64[F64, "rows width"]:
    if len(numbers) == 0 or len(numbers) % width:
        raise BrdfError(
            f"the rows hold {width} numbers each, but {len(numbers) % width} are left over"
            if len(numbers)
            else "the measurement has no rows"
        )
    rows = numbers.reshape(-1, width)
    bad = ~np.isfinite(rows)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise BrdfError(f"row {row + 1}, column {column + 1}: {rows[row, column]} is not finite")
    return rows


def _spectral(numbers: Float64[F64, " n"]) -> ScatteredSamples:
    count = float(numbers[0]) if len(numbers) else 0.0
    if not (1.0 <= count <= MAX_WAVELENGTHS and count == int(count)):
        raise BrdfError(f"the first number, {count:g}, is no count of wavelengths")
    n_waves = int(count)
    if len(numbers) < 1 + n_waves:
        raise BrdfError(f"the file ends within its {n_waves} wavelengths")
    wavelengths = numbers[1 : 1 + n_waves]
    rows = _rows(numbers[1 + n_waves :], 4 + n_waves)
    theta_i, phi_i, theta_o, phi_o = rows[:, :4].T
    spectra = rows[:, 4:]
    weights = np.full((1, 3), 1.0) if n_waves == 1 else rgb_weights(wavelengths)
    facts = {
        "kind": "spectral",
        "n_wavelengths": n_waves,
        "wavelengths_nm": [float(wavelengths[0]), float(wavelengths[-1])],
    }
    negative: B8 = np.any(spectra < 0.0, axis=1)
    return _samples(theta_i, theta_o, phi_o - phi_i, spectra @ weights, negative, facts)


def _alta(numbers: Float64[F64, " n"], header: dict[str, str]) -> ScatteredSamples:
    dimensions = header.get("DIM", "").split()
    if dimensions not in (["3", "1"], ["3", "3"]) or header.get("VS", "0") != "0":
        raise BrdfError(
            f"#DIM {header.get('DIM', 'is missing')}, #VS {header.get('VS', '0')}: three inputs, "
            "one or three outputs and no variances are read"
        )
    if header.get("PARAM_IN") != ALTA_INPUT:
        raise BrdfError(f"#PARAM_IN {header.get('PARAM_IN')} is not read, {ALTA_INPUT} is")
    output = header.get("PARAM_OUT", "INV_STERADIAN")
    if output not in ALTA_OUTPUTS:
        raise BrdfError(f"#PARAM_OUT {output} is none of {', '.join(ALTA_OUTPUTS)}")
    rows = _rows(numbers, 3 + int(dimensions[1]))
    theta_i, across, up = rows[:, :3].T
    theta_o, values = np.hypot(across, up), rows[:, 3:]
    negative: B8 = np.any(values < 0.0, axis=1)
    if ALTA_OUTPUTS[output]:
        values = values / np.maximum(np.cos(theta_o), MIN_COSINE)[:, None]
    facts = {"kind": "alta", "sample": header.get("SAMPLE", "").strip('"'), "output": output}
    rgb = np.broadcast_to(values, (len(values), 3))
    return _samples(theta_i, theta_o, np.arctan2(up, across), rgb, negative, facts)


def _samples(
    theta_i: Float64[F64, " rows"],
    theta_o: Float64[F64, " rows"],
    dphi: Float64[F64, " rows"],
    rgb: Float64[F64, "rows 3"],
    negative: Bool[B8, " rows"],
    facts: dict[str, Any],
) -> ScatteredSamples:
    """Check the angles; leave out samples that are negative or at the horizon; count them."""
    for name, theta in (("light", theta_i), ("view", theta_o)):
        outside = (theta < 0.0) | (theta > 0.5 * np.pi + 1e-6)
        if outside.any():
            row = int(outside.argmax())
            raise BrdfError(
                f"row {row + 1}: {theta[row]:g} is no angle of the {name} in radians above the "
                "horizon"
            )
    if (rgb > MAX_VALUE).any():
        row = int((rgb > MAX_VALUE).any(axis=1).argmax())
        raise BrdfError(f"row {row + 1}: {rgb[row].max():g} exceeds {MAX_VALUE:g}")
    low = np.minimum(np.cos(theta_i), np.cos(theta_o)) < MIN_COSINE
    kept = ~(negative | low)
    if not kept.any():
        raise BrdfError("no sample is left above the horizon")
    facts = facts | {
        "n_samples": len(kept),
        "n_negative": int(negative.sum()),
        "n_at_horizon": int((low & ~negative).sum()),
        "n_outside_gamut": int((rgb[kept] < 0.0).any(axis=1).sum()),
        "n_lights": len(np.unique(np.rad2deg(theta_i[kept]).round())),
        "max_theta_deg": float(np.rad2deg(np.maximum(theta_i, theta_o)[kept].max())),
    }
    return ScatteredSamples(
        _direction(theta_i[kept], np.zeros(int(kept.sum()))),
        _direction(theta_o[kept], dphi[kept]),
        # colours more saturated than Rec.709 has are cut to it
        np.maximum(rgb[kept], 0.0),
        facts,
    )


def _direction(theta: Float64[F64, " n"], phi: Float64[F64, " n"]) -> Float64[F64, "n 3"]:
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], axis=-1)
