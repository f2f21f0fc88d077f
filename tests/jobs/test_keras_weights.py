import io

import h5py
import numpy as np
import pytest

from prtbake_storage.errors import BrdfError
from prtbake_workers.jobs.keras_weights import is_hdf5, read_keras_weights
from support.keras_file import network


def replaced(path, value):
    def change(file):
        del file[path]
        if value is not None:
            file[path] = value

    return change


def test_weights_arrive_in_their_layers():
    data = network()
    spec = read_keras_weights(data)
    with h5py.File(io.BytesIO(data)) as file:
        for index, layer in enumerate(spec.layers):
            name = f"dense_{index + 1}"
            np.testing.assert_array_equal(layer.weights, file[f"{name}/{name}/kernel:0"][()])
            np.testing.assert_array_equal(layer.biases, file[f"{name}/{name}/bias:0"][()])
    assert is_hdf5(data)
    assert not is_hdf5(b"{}")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (replaced("dense_2/dense_2/bias:0", None), "has no dense_2/dense_2/bias:0"),
        (replaced("dense_1/dense_1/kernel:0", np.zeros((6, 21), np.int32)), "no float array"),
        (replaced("dense_1/dense_1/kernel:0", np.zeros(6)), "with 2 axes"),
        (replaced("dense_1/dense_1/kernel:0", np.zeros((6, 20))), "row 0 of the weights"),
        (replaced("dense_3/dense_3/kernel:0", np.zeros((20, 3))), "layer 2 takes 20"),
        (replaced("dense_1/dense_1/bias:0", np.full(21, np.nan)), "NaN"),
        (replaced("dense_1/dense_1/kernel:0", np.zeros((6, 1000))), "shape"),
        (replaced("dense_1/dense_1/kernel:0", h5py.ExternalLink("other.h5", "/x")), "kernel:0 of its own"),
        (replaced("dense_1/dense_1/kernel:0", h5py.SoftLink("/dense_2/dense_2/kernel:0")), "no dense_1/dense_1/kernel:0 of its own"),
        (replaced("dense_3/dense_3", np.zeros(3)), "no dense_3/dense_3/kernel:0"),
    ],
)  # fmt: skip
def test_a_refusal_names_the_dataset(change, says):
    with pytest.raises(BrdfError, match=says):
        read_keras_weights(network(change))


def test_a_size_that_was_never_written_is_not_read():
    def huge(file):
        del file["dense_1/dense_1/kernel:0"]
        file.create_dataset("dense_1/dense_1/kernel:0", (1 << 20, 1 << 20), "f4", chunks=(64, 64))

    with pytest.raises(BrdfError, match="1048576"):
        read_keras_weights(network(huge))


@pytest.mark.parametrize("keep", [8, 100, 2000])
def test_a_truncated_file_is_damaged(keep):
    with pytest.raises(BrdfError, match=r"damaged|no dense|cannot"):
        read_keras_weights(network()[:keep])
