"""Fitted lights of every method through HDF5, and files that break a rule."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from prtbake_storage.decode.light import HarmonicLight, LightFit, WaveletLight
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5.light import read_light, write_light
from prtbake_storage.hdf5.resources import read_mesh
from support.quadrature import random_directions


@pytest.fixture
def lights(rng: np.random.Generator) -> dict:
    common = {"error": 0.25, "provenance": {"seed": 1}}
    lobes = LightFit(
        centres=random_directions(rng, 7), bandwidths=rng.random(7) + 1,
        coefficients=rng.normal(size=(7, 3)), **common,
    )  # fmt: skip
    return {
        "srbf_scattered": lobes,
        "srbf_uniform": replace(lobes, method="srbf_uniform"),
        "sh": HarmonicLight(coefficients=rng.normal(size=(9, 3)), **common),
        "wavelet": WaveletLight(
            resolution=4, indices=np.array([0, 5, 95], np.int32),
            coefficients=rng.normal(size=(3, 3)), **common,
        ),
    }  # fmt: skip


@pytest.mark.parametrize("method", ["srbf_scattered", "srbf_uniform", "sh", "wavelet"])
def test_a_light_comes_back(lights: dict, tmp_path: Path, method: str) -> None:
    light, path = lights[method], tmp_path / "l.h5"
    write_light(path, light)
    back = read_light(path)
    assert type(back) is type(light)
    assert (back.method, back.error, back.provenance) == (method, 0.25, {"seed": 1})
    for name in ("centres", "bandwidths", "indices", "coefficients", "resolution"):
        if hasattr(light, name):
            np.testing.assert_array_equal(getattr(back, name), getattr(light, name))
    first = path.read_bytes()
    write_light(path, light)
    assert path.read_bytes() == first
    with pytest.raises(CorruptArtefact, match="kind"):
        read_mesh(path)


def test_files_of_scattered_lobes_carry_no_method(lights: dict, tmp_path: Path) -> None:
    """As they never did: equal lights stay equal bytes."""
    for method, light in lights.items():
        write_light(tmp_path / "l.h5", light)
        with h5py.File(tmp_path / "l.h5") as file:
            assert ("method" in file["light"].attrs) == (method != "srbf_scattered")


@pytest.mark.parametrize(
    ("method", "changes", "complaint"),
    [
        ("srbf_scattered", {"bandwidths": -np.ones(7)}, "/light/bandwidths"),
        ("srbf_uniform", {"centres": np.ones((7, 3))}, "/light/centres"),
        ("sh", {"coefficients": np.zeros((8, 3))}, "/light/coefficients"),
        ("wavelet", {"resolution": 6}, "/light/resolution is 6"),
        ("wavelet", {"indices": np.array([0, 5, 5], np.int32)}, "/light/indices"),
        ("wavelet", {"indices": np.array([0, 5], np.int32)}, "/light/coefficients"),
    ],
)
def test_what_breaks_a_rule_is_named(
    lights: dict, tmp_path: Path, method: str, changes: dict, complaint: str
) -> None:
    write_light(tmp_path / "l.h5", replace(lights[method], **changes))
    with pytest.raises(CorruptArtefact, match=complaint):
        read_light(tmp_path / "l.h5")


@pytest.mark.parametrize(
    ("name", "value"),
    [("method", b"fourier"), ("error", b"none"), ("error", np.nan), ("error", -1.0)],
)
def test_a_wrong_attribute_is_named(
    lights: dict, tmp_path: Path, name: str, value: bytes | float
) -> None:
    write_light(tmp_path / "l.h5", lights["sh"])
    with h5py.File(tmp_path / "l.h5", "a") as file:
        file["light"].attrs[name] = np.bytes_(value) if isinstance(value, bytes) else value
    with pytest.raises(CorruptArtefact, match=name):
        read_light(tmp_path / "l.h5")
