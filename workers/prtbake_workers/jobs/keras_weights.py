"""Weights of an nbrdf network out of a Keras HDF5 file."""

import io
from typing import Any

import h5py
import numpy as np
from pydantic import ValidationError

from prtbake_storage.contract.brdf_fits import HIDDEN_MAX, DenseLayer, NbrdfSpec
from prtbake_storage.errors import BrdfError

SIGNATURE = b"\x89HDF\r\n\x1a\n"
N_LAYERS = 3
_INSIDE = h5py.HardLink


def is_hdf5(data: bytes) -> bool:
    """Tell whether the bytes begin like an HDF5 file."""
    return data.startswith(SIGNATURE)


def read_keras_weights(data: bytes) -> NbrdfSpec:
    """Read ``dense_1`` to ``dense_3``, each with ``kernel:0`` and ``bias:0``.

    Raises
    ------
    BrdfError
        A dataset is missing, has another shape or type, or holds NaN; the message names it.
    """
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            layers = [_layer(file, f"dense_{index + 1}") for index in range(N_LAYERS)]
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        if isinstance(error, BrdfError):
            raise
        raise BrdfError(f"the HDF5 file is damaged: {error}") from error
    try:
        return NbrdfSpec(layers=(layers[0], layers[1], layers[2]))
    except ValidationError as error:
        raise BrdfError(f"the network: {error.errors()[0]['msg']}") from error


def _layer(file: h5py.File, name: str) -> DenseLayer:
    kernel = _numbers(file, f"{name}/{name}/kernel:0", 2)
    bias = _numbers(file, f"{name}/{name}/bias:0", 1)
    try:
        return DenseLayer(
            weights=tuple(tuple(float(x) for x in row) for row in kernel),
            biases=tuple(float(x) for x in bias),
        )
    except ValidationError as error:
        raise BrdfError(f"{name}: {error.errors()[0]['msg']}") from error


def _numbers(file: h5py.File, path: str, axes: int) -> Any:
    """Read a small float dataset that lies in this very file."""
    found: Any = file
    for step in path.split("/"):
        # a link could lead to another file of this machine
        if not isinstance(found, h5py.Group) or type(found.get(step, getlink=True)) is not _INSIDE:
            raise BrdfError(f"the HDF5 file is no nbrdf network: it has no {path} of its own")
        found = found[step]
    if not isinstance(found, h5py.Dataset) or found.dtype.kind != "f" or found.ndim != axes:
        raise BrdfError(f"{path} is no float array with {axes} axes")
    if found.is_virtual or found.external or max(found.shape) > HIDDEN_MAX or not found.size:
        raise BrdfError(f"{path} has shape {found.shape}; layers have 1 to {HIDDEN_MAX} units")
    values = np.asarray(found[()], np.float64)
    if not np.isfinite(values).all():
        raise BrdfError(f"{path} holds NaN or infinity")
    return values
