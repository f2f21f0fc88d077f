"""The group ``basis`` of transfer and asset files: the functions that coefficients belong to.

Attribute ``kind`` is ``sh`` for spherical harmonics of ``order`` bands.  Without it the functions
are the whitened Gaussian SRBFs of the ``centres``: files of these never carried it.
"""

import h5py
import numpy as np

from prtbake_storage.decode.sh import MOST_ORDER
from prtbake_storage.decode.transfer_basis import SphericalHarmonics, TransferBasis, WhitenedSrbfs
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5 import primitives as h5
from prtbake_storage.hdf5.resources import check_unit


def put_basis(file: h5py.File, basis: TransferBasis) -> None:
    """Write a basis; the light axis of transfer and of every factor lives in its span."""
    group = h5.group(file, "basis")
    match basis:
        case WhitenedSrbfs(centres, bandwidth):
            h5.set_attribute(group, "kernel", "gaussian")
            h5.set_attribute(group, "bandwidth", float(bandwidth))
            h5.set_attribute(group, "whitened", 1)
            h5.put(group, "centres", centres.astype(np.float64), "coeffs xyz")
        case SphericalHarmonics(order):
            h5.set_attribute(group, "kind", basis.kind)
            h5.set_attribute(group, "order", order)
        case _:
            raise TypeError(f"no file holds a {type(basis).__name__}")


def get_basis(file: h5py.File) -> TransferBasis:
    """Read a basis.

    Raises
    ------
    CorruptArtefact
        It is of no kind that is known, or its numbers are out of range.
    """
    group = h5.child(file, "basis")
    if h5.has_attribute(group, "kind"):
        return _harmonics(group)
    if h5.attribute(group, "kernel") != "gaussian" or h5.attribute(group, "whitened") != 1:
        raise CorruptArtefact("/basis is not a whitened Gaussian basis")
    centres = h5.get(group, "centres", "f", (None, 3)).astype(np.float64)
    check_unit("/basis/centres", centres)
    bandwidth = h5.attribute(group, "bandwidth")
    if not isinstance(bandwidth, int | float) or not 0 < bandwidth < np.inf:
        raise CorruptArtefact(f"/basis: bandwidth is {bandwidth!r}")
    return WhitenedSrbfs(centres, float(bandwidth))


def _harmonics(group: h5py.Group) -> SphericalHarmonics:
    kind = h5.attribute(group, "kind")
    if kind != "sh":
        raise CorruptArtefact(f"/basis: kind is {kind!r}, not 'sh'")
    order = h5.attribute(group, "order")
    if not isinstance(order, int) or not 1 <= order <= MOST_ORDER:
        raise CorruptArtefact(f"/basis: order is {order!r}, not in 1 to {MOST_ORDER}")
    return SphericalHarmonics(order)
