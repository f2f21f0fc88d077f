"""Whether a BRDF has the symmetry that it claims: a plugin's is its own word."""

import numpy as np

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import Brdf


def check_isotropy(brdf: Brdf) -> None:
    """Refuse a BRDF that a common turn or a mirror changes: half circles would misread it.

    Raises
    ------
    BrdfError
        Values at three pairs of directions differ where the pair is turned or mirrored.
    """
    theta = np.array([0.2, 0.7, 1.2])
    turn = np.array([0.0, 1.0, 2.5])
    delta = 0.8
    wi = _directions(theta, np.zeros(3))
    reference = brdf.eval_brdf(wi, _directions(theta[::-1], np.full(3, delta)))
    for sign in (1.0, -1.0):
        turned = brdf.eval_brdf(
            _directions(theta, turn), _directions(theta[::-1], turn + sign * delta)
        )
        if not np.allclose(turned, reference, rtol=1e-9, atol=1e-12):
            raise BrdfError("the BRDF is not isotropic and mirror-symmetric")


def _directions(theta: Float64[F64, " n"], phi: Float64[F64, " n"]) -> Float64[F64, "n 3"]:
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], axis=-1)
