"""A Keras file with the weights of an nbrdf network."""

import io

import h5py
import numpy as np

SHAPES = ((6, 21), (21, 21), (21, 3))


def network(change=None):
    """A Keras file of random weights; ``change`` may spoil it."""
    rng = np.random.default_rng(5)
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for index, shape in enumerate(SHAPES):
            name = f"dense_{index + 1}"
            group = file.create_group(f"{name}/{name}")
            group["kernel:0"] = rng.standard_normal(shape).astype(np.float32)
            group["bias:0"] = rng.standard_normal(shape[1]).astype(np.float32)
        file.create_group("lambda_1")
        if change is not None:
            change(file)
    return buffer.getvalue()
