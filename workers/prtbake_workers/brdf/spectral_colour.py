"""Spectral reflectance to linear Rec.709, under daylight."""

import numpy as np

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import F64, Float64

WAVELENGTHS = np.arange(400.0, 701.0, 10.0)
"""Nodes of the tables below, in nm: 99.5 % of the luminance of daylight."""

OBSERVER = np.array([
    [0.01431, 0.000396, 0.06785], [0.04351, 0.00121, 0.2074], [0.13438, 0.004, 0.6456],
    [0.2839, 0.0116, 1.3856], [0.34828, 0.023, 1.74706], [0.3362, 0.038, 1.77211],
    [0.2908, 0.06, 1.6692], [0.19536, 0.09098, 1.28764], [0.09564, 0.13902, 0.81295],
    [0.03201, 0.20802, 0.46518], [0.0049, 0.323, 0.272], [0.0093, 0.503, 0.1582],
    [0.06327, 0.71, 0.07825], [0.1655, 0.862, 0.04216], [0.2904, 0.954, 0.0203],
    [0.43345, 0.99495, 0.00875], [0.5945, 0.995, 0.0039], [0.7621, 0.952, 0.0021],
    [0.9163, 0.87, 0.00165], [1.0263, 0.757, 0.0011], [1.0622, 0.631, 0.0008],
    [1.0026, 0.503, 0.00034], [0.85445, 0.381, 0.00019], [0.6424, 0.265, 0.00005],
    [0.4479, 0.175, 0.00002], [0.2835, 0.107, 0.0], [0.1649, 0.061, 0.0], [0.0874, 0.032, 0.0],
    [0.04677, 0.017, 0.0], [0.0227, 0.00821, 0.0], [0.01136, 0.0041, 0.0],
])  # fmt: skip
"""Colour matching functions of the CIE 1931 observer, 2 degrees."""

DAYLIGHT = np.array([
    82.75, 91.49, 93.43, 86.68, 104.87, 117.01, 117.81, 114.86, 115.92, 108.81, 109.35, 107.80,
    104.79, 107.69, 104.41, 104.05, 100.00, 96.33, 95.79, 88.69, 90.01, 89.60, 87.70, 83.29, 83.70,
    80.03, 80.21, 82.28, 78.28, 69.72, 71.61,
])  # fmt: skip
"""Relative power of the CIE illuminant D65, which is the white of Rec.709."""

XYZ_TO_REC709 = np.array([
    [3.2404542, -1.5371385, -0.4985314],
    [-0.9692660, 1.8760108, 0.0415560],
    [0.0556434, -0.2040259, 1.0572252],
])  # fmt: skip

NEEDED = (450.0, 650.0)
"""What a measurement must span, in nm: outside it the ends are held."""


def rgb_weights(wavelengths: Float64[F64, " n"]) -> Float64[F64, "n 3"]:
    """Give the weights that turn reflectances at some wavelengths into linear Rec.709.

    The reflectance is linear between its wavelengths, held beyond them, and seen under D65.  A
    constant one is its own colour in every channel.

    Raises
    ------
    BrdfError
        The wavelengths do not rise, or span too little of the visible ones.
    """
    if (np.diff(wavelengths) <= 0.0).any():
        raise BrdfError("the wavelengths do not rise")
    if wavelengths[0] > NEEDED[0] or wavelengths[-1] < NEEDED[1]:
        raise BrdfError(
            f"the wavelengths span {wavelengths[0]:g} to {wavelengths[-1]:g} nm, colour needs "
            f"{NEEDED[0]:g} to {NEEDED[1]:g}"
        )
    unit = np.eye(len(wavelengths))
    at_nodes = np.stack([np.interp(WAVELENGTHS, wavelengths, row) for row in unit])
    weights = at_nodes @ (DAYLIGHT[:, None] * OBSERVER) @ XYZ_TO_REC709.T
    # the cut tails of the tables shift white by 1e-3, which is set right channel by channel
    return np.asarray(weights / weights.sum(axis=0))
