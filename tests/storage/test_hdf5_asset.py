"""Assets through HDF5: nothing lost, nothing random, nothing believed."""

import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest

from prtbake_storage.decode.asset import Asset, Part
from prtbake_storage.decode.quantise import peak_scales, quantise_asset
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.writer import write_asset
from support.means import with_means


def differences(a: object, b: object, where: str = "") -> list[str]:
    """Names of all fields in which two records differ, bit for bit."""
    if dataclasses.is_dataclass(a) and type(a) is type(b):
        return [
            name
            for field in dataclasses.fields(a)
            for name in differences(
                getattr(a, field.name), getattr(b, field.name), f"{where}/{field.name}"
            )
        ]
    if isinstance(a, np.ndarray):
        same = isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
        return [] if same else [where]
    if isinstance(a, tuple) and isinstance(b, tuple) and len(a) == len(b):
        return [
            n
            for i, (x, y) in enumerate(zip(a, b, strict=True))
            for n in differences(x, y, f"{where}/{i}")
        ]
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return [name for key in a for name in differences(a[key], b[key], f"{where}/{key}")]
    return [] if a == b else [where]


@pytest.mark.parametrize("bits", [8, 16, 32])
def test_what_write_returns_is_what_read_gives(asset: Asset, tmp_path: Path, bits: int) -> None:
    seen = write_asset(tmp_path / "a.h5", asset, bits=bits)
    assert differences(seen, read_asset(tmp_path / "a.h5")) == []
    assert differences(seen, quantise_asset(asset, bits)) == []
    assert (differences(seen, asset) == []) == (bits == 32)
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


def mixed_scales(asset: Asset) -> list[dict[str, np.ndarray]]:
    """Scales of 3 to 13 bits, another number for every factor, and a column that is dropped."""
    chosen = []
    for start, part in zip((3, 8), asset.parts, strict=True):
        names = list(peak_scales(part, 16))
        scales = {name: peak_scales(part, start + i)[name] for i, name in enumerate(names)}
        scales["weights"][1, 1] = 0.0
        chosen.append(scales)
    return chosen


def test_scales_of_ones_own(asset: Asset, tmp_path: Path) -> None:
    path, scales = tmp_path / "a.h5", mixed_scales(asset)
    seen = write_asset(path, asset, bits=scales, errors=[1e-3, 0.0])
    back = read_asset(path)
    assert differences(seen, back) == []
    assert differences(seen, quantise_asset(asset, scales, [1e-3, 0.0])) == []
    assert [part.precision.error for part in back.parts if part.precision] == [1e-3, 0.0]
    glossy = back.parts[0].precision
    assert glossy is not None
    assert dict(glossy.bits) == {"weights": 3, "light_bases": 4, "dual_bases": 5, "view_texture": 6}
    with h5py.File(path) as file:
        assert file.attrs["bits"] == 10
        types = {name: file[f"parts/1/{name}"].dtype
                 for name in ("weights", "clusters/means", "clusters/components")}  # fmt: skip
        labels = file["parts/0/clusters/labels"].dtype
    assert types == {
        "weights": np.int8, "clusters/means": np.int16, "clusters/components": np.int16,
    }  # fmt: skip
    assert labels == np.int8
    # without a measured error the file says none
    write_asset(path, asset, bits=scales)
    assert [p.precision.error for p in read_asset(path).parts if p.precision] == [None, None]


@pytest.mark.parametrize("clusters", [127, 128, 129, 40_000])
def test_labels_take_the_smallest_type(asset: Asset, tmp_path: Path, clusters: int) -> None:
    part = asset.parts[1]
    labels = np.linspace(0, clusters - 1, part.n_vertices).astype(np.int32)
    zeros = {"means": (clusters, 42), "components": (clusters, 2, 42)}
    many = dataclasses.replace(
        part, labels=labels, ranks=np.ones((clusters, 3), np.int32),
        **{name: np.zeros(shape, np.float32) for name, shape in zeros.items()},
    )  # fmt: skip
    path = tmp_path / "a.h5"
    write_asset(path, dataclasses.replace(asset, parts=(asset.parts[0], many)))
    np.testing.assert_array_equal(read_asset(path).parts[1].labels, labels)
    with h5py.File(path) as file:
        expected = np.int8 if clusters <= 128 else np.int16 if clusters <= 32768 else np.int32
        assert file["parts/1/clusters/labels"].dtype == expected


def test_files_from_before_bits_were_chosen_are_read(asset: Asset, tmp_path: Path) -> None:
    """They hold int16 without offset and bits, and labels of 32 bits."""
    path = tmp_path / "a.h5"
    write_asset(path, asset)

    def make_old(name: str, node: object) -> None:
        if isinstance(node, h5py.Dataset) and "offset" in node.attrs:
            node[...] = node[...] - node.attrs["offset"]
            del node.attrs["offset"], node.attrs["bits"]

    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        file.visititems(make_old)
    for index, part in enumerate(asset.parts):
        edited(path, f"parts/{index}/clusters/labels", part.labels)
    assert differences(quantise_asset(asset, 16), read_asset(path)) == []


@pytest.mark.parametrize(
    ("name", "attribute", "value"),
    [
        ("parts/0/weights", "bits", 15),
        ("parts/0/weights", "bits", b"16"),
        ("parts/0/clusters/light_bases", "offset", 1 << 15),
        ("parts/0/clusters/light_bases", "offset", -128),
        ("parts/1/clusters/means", "offset", 0.5),
        ("parts/1", "quantisation_error", -1e-3),
        ("parts/1", "quantisation_error", float("nan")),
    ],
)
def test_a_precision_that_is_not_that_of_the_levels_is_refused(
    asset: Asset, tmp_path: Path, name: str, attribute: str, value: object
) -> None:
    path = tmp_path / "a.h5"
    write_asset(path, asset, errors=[1e-3, 1e-3])
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        file[name].attrs[attribute] = value
    with pytest.raises(CorruptArtefact, match=f"/{name}: {attribute} is"):
        read_asset(path)


@pytest.mark.parametrize("bits", [16, 32])
def test_three_channels_come_back(coloured: Asset, tmp_path: Path, bits: int) -> None:
    seen = write_asset(tmp_path / "a.h5", coloured, bits=bits)
    back = read_asset(tmp_path / "a.h5")
    assert [part.n_channels for part in back.parts] == [3, 3]
    assert differences(seen, back) == []
    one = dataclasses.replace(coloured.parts[1], n_channels=1)
    with pytest.raises(ValueError, match=r"parts/1/clusters/means has shape \(4, 126\)"):
        write_asset(
            tmp_path / "b.h5", dataclasses.replace(coloured, parts=(coloured.parts[0], one))
        )


@pytest.mark.parametrize("bits", [16, 32])
@pytest.mark.parametrize("method", ["vq", "pca", "cpca"])
@pytest.mark.parametrize("n_channels", [1, 3])
def test_means_of_several_terms_come_back(
    asset: Asset, coloured: Asset, tmp_path: Path, bits: int, method: str, n_channels: int
) -> None:
    own = coloured if n_channels == 3 else asset
    part = with_means(own.parts[0], method, own.n_coeffs, np.random.default_rng(5))
    own = dataclasses.replace(own, parts=(part, own.parts[1]))
    seen = write_asset(tmp_path / "a.h5", own, bits=bits)
    back = read_asset(tmp_path / "a.h5")
    assert differences(seen, back) == []
    assert (differences(back, own) == []) == (bits == 32)
    assert back.parts[0].method == method
    # negative twin: other means are another file
    other = dataclasses.replace(part, means=-part.means)
    other = dataclasses.replace(own, parts=(other, own.parts[1]))
    assert "/parts/0/means" in differences(write_asset(tmp_path / "b.h5", other, bits=bits), back)


@pytest.mark.parametrize("bits", [16, 32])
def test_what_vector_quantisation_does_not_have_costs_no_bytes(
    asset: Asset, tmp_path: Path, bits: int
) -> None:
    held = {}
    for method in ("vq", "cpca"):
        part = with_means(asset.parts[0], method, asset.n_coeffs, np.random.default_rng(5))
        path = tmp_path / f"{method}.h5"
        write_asset(path, dataclasses.replace(asset, parts=(part, asset.parts[1])), bits=bits)
        with h5py.File(path) as file:
            held[method] = {*file["parts/0"], *file["parts/0/clusters"]}
    lacking = {"weights", "components"}
    if bits == 16:
        lacking |= {"weights_scale", "components_scale"}
    assert held["cpca"] - held["vq"] == lacking
    with h5py.File(tmp_path / "vq.h5", "r+", libver=("v110", "v110")) as file:
        file["parts/0"].attrs["method"] = np.bytes_(b"cpca")
    with pytest.raises(CorruptArtefact, match="/parts/0/clusters/components is missing"):
        read_asset(tmp_path / "vq.h5")
    with h5py.File(tmp_path / "vq.h5", "r+", libver=("v110", "v110")) as file:
        file["parts/0"].attrs["method"] = np.bytes_(b"svd")
    with pytest.raises(CorruptArtefact, match="/parts/0: method is 'svd'"):
        read_asset(tmp_path / "vq.h5")


@pytest.mark.parametrize("bits", [16, 32])
def test_the_same_asset_gives_the_same_bytes(asset: Asset, tmp_path: Path, bits: int) -> None:
    write_asset(tmp_path / "a.h5", asset, bits=bits)
    write_asset(tmp_path / "b.h5", asset, bits=bits)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    other = dataclasses.replace(asset, provenance={"seed": 4})
    write_asset(tmp_path / "c.h5", other, bits=bits)
    assert (tmp_path / "a.h5").read_bytes() != (tmp_path / "c.h5").read_bytes()


def test_any_changed_byte_is_found_or_changes_nothing(asset: Asset, tmp_path: Path) -> None:
    """Free space inside the file is not read; every other byte is under a checksum."""
    path, bad = tmp_path / "a.h5", tmp_path / "bad.h5"
    seen = write_asset(path, asset)
    data = path.read_bytes()
    found = 0
    places = range(0, len(data), len(data) // 150)
    for place in places:
        bad.write_bytes(data[:place] + bytes([data[place] ^ 0x10]) + data[place + 1 :])
        try:
            assert differences(seen, read_asset(bad)) == [], f"byte {place} went unnoticed"
        except CorruptArtefact:
            found += 1
    # the rest is slack that the library leaves between objects
    assert found > 0.5 * len(places), found


def test_a_flipped_byte_of_a_dataset_names_the_dataset(asset: Asset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_asset(path, asset)
    with h5py.File(path) as file:
        place = file["parts/0/clusters/light_bases"].id.get_chunk_info(0).byte_offset
    data = bytearray(path.read_bytes())
    data[place + 20] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(CorruptArtefact, match="/parts/0/clusters/light_bases"):
        read_asset(path)


@pytest.mark.parametrize("length", [0, 7, 100, 3000])
def test_a_truncated_file_is_refused(asset: Asset, tmp_path: Path, length: int) -> None:
    path = tmp_path / "a.h5"
    write_asset(path, asset)
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(CorruptArtefact):
        read_asset(path)


def edited(path: Path, name: str, value: np.ndarray | None, **attributes: object) -> None:
    """Replace a dataset by one with the same filters, as a hostile writer would."""
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        del file[name]
        if value is not None:
            made = file.create_dataset(name, data=value, chunks=value.shape, compression="gzip")
            made.attrs.update(attributes)


BREAKS = {
    "mesh/faces": np.full((20, 3), 90, np.int32),
    "mesh/positions": np.full((90, 3), np.nan, np.float32),
    "mesh/normals": np.zeros((90, 3), np.int16),
    "parts/0/clusters/labels": np.full(60, -1, np.int32),
    # as int32 they would wrap to 0 and 1
    "parts/1/clusters/labels": np.full(30, 1 << 32, np.int64),
    "parts/0/clusters/ranks": np.full((4, 3), (1 << 32) + 1, np.int64),
    "parts/0/clusters/dual_bases": np.zeros((4, 4, 14), np.int16),
    "parts/0/weights": np.zeros((59, 4), np.int16),
    "parts/0/view_texture_scale": np.full((1, 1, 3, 3), np.inf, np.float32),
    "parts/1/clusters/means": np.zeros((4, 41), np.float32),
    "parts/1/albedo": np.zeros(2, np.float32),
    "parts/1/material": np.array([b"[1, 2"]),
    "basis/centres": np.zeros((42, 3)),
    "provenance": np.array([b"[]"]),
}


@pytest.mark.parametrize("name", BREAKS)
def test_a_dataset_that_breaks_the_schema_is_named(asset: Asset, tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.h5"
    write_asset(path, asset)
    edited(path, name, BREAKS[name])
    with pytest.raises(CorruptArtefact, match=name.rsplit("_scale")[0]):
        read_asset(path)


@pytest.mark.parametrize(
    ("part", "place", "value", "most"),
    [
        (0, (1, 0), 4, 3),  # view, of the view basis
        (0, (0, 1), -1, 5),  # light, of the light bases
        (0, (3, 2), 99, 4),  # vertices, of the weights
        (1, (0, 1), 43, 42),  # coefficients, of the basis
        (1, (2, 2), 1 << 30, 2),
    ],
)
def test_ranks_beyond_the_arrays_are_refused(
    asset: Asset, tmp_path: Path, part: int, place: tuple[int, int], value: int, most: int
) -> None:
    path = tmp_path / "a.h5"
    write_asset(path, asset)
    ranks = asset.parts[part].ranks.copy()
    ranks[place] = most
    name = f"parts/{part}/clusters/ranks"
    edited(path, name, ranks)
    read_asset(path)
    ranks[place] = value
    edited(path, name, ranks)
    with pytest.raises(CorruptArtefact, match=f"{name} is {value} at .*outside 0 to {most}"):
        read_asset(path)


@pytest.mark.parametrize("name", ["mesh/faces", "parts/0/weights", "provenance", "basis/centres"])
def test_a_missing_dataset_is_named(asset: Asset, tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.h5"
    write_asset(path, asset)
    edited(path, name, None)
    with pytest.raises(CorruptArtefact, match=name):
        read_asset(path)


def test_links_out_of_the_file_are_not_followed(asset: Asset, tmp_path: Path) -> None:
    path, other = tmp_path / "a.h5", tmp_path / "other.h5"
    write_asset(path, asset)
    write_asset(other, asset)
    for link in (h5py.ExternalLink(str(other), "/mesh"), h5py.SoftLink("/parts")):
        with h5py.File(path, "r+", libver=("v110", "v110")) as file:
            del file["mesh"]
            file["mesh"] = link
        with pytest.raises(CorruptArtefact, match="/mesh is a link"):
            read_asset(path)


def test_data_kept_outside_the_file_is_not_read(asset: Asset, tmp_path: Path) -> None:
    path, other = tmp_path / "a.h5", tmp_path / "other.h5"
    write_asset(path, asset)
    write_asset(other, asset, bits=32)
    layout = h5py.VirtualLayout(shape=(90, 3), dtype=np.float32)
    layout[:] = h5py.VirtualSource(other, "mesh/positions", shape=(90, 3))
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        del file["mesh/positions"]
        file.create_virtual_dataset("mesh/positions", layout)
    with pytest.raises(CorruptArtefact, match="/mesh/positions is not stored as chunks"):
        read_asset(path)
    raw = tmp_path / "raw.bin"
    raw.write_bytes(bytes(90 * 3 * 4))
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        del file["mesh/positions"]
        file.create_dataset(
            "mesh/positions", (90, 3), np.float32, external=[(str(raw), 0, 90 * 3 * 4)]
        )
    with pytest.raises(CorruptArtefact, match="/mesh/positions is not stored as chunks"):
        read_asset(path)


def test_a_claim_of_terabytes_is_refused_before_memory_is_asked_for(
    asset: Asset, tmp_path: Path
) -> None:
    path = tmp_path / "a.h5"
    write_asset(path, asset)
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        del file["mesh/positions"]
        file.create_dataset("mesh/positions", (1 << 40, 3), np.float32, chunks=(1024, 3))
    with pytest.raises(CorruptArtefact, match="never written"):
        read_asset(path)


def test_object_references_are_refused(asset: Asset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_asset(path, asset)
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        del file["mesh/faces"]
        file.create_dataset(
            "mesh/faces", data=np.array([[file["mesh"].ref] * 3], h5py.ref_dtype), chunks=(1, 3)
        )
    with pytest.raises(CorruptArtefact, match="/mesh/faces holds"):
        read_asset(path)


@pytest.mark.parametrize(
    ("name", "value"), [("format", b"other"), ("version", 99), ("kind", b"light")]
)
def test_another_format_version_or_kind_is_refused(
    asset: Asset, tmp_path: Path, name: str, value: object
) -> None:
    path = tmp_path / "a.h5"
    write_asset(path, asset)
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        file.attrs[name] = value
    with pytest.raises(CorruptArtefact, match=name):
        read_asset(path)


@pytest.mark.parametrize("value", [2, 0, 1.0, b"3"])
def test_channels_other_than_one_or_three_are_refused(
    asset: Asset, tmp_path: Path, value: object
) -> None:
    path = tmp_path / "a.h5"
    write_asset(path, asset)
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        file["parts/1"].attrs["n_channels"] = value
    with pytest.raises(CorruptArtefact, match="/parts/1: n_channels is"):
        read_asset(path)


def test_a_failed_write_leaves_nothing(asset: Asset, tmp_path: Path) -> None:
    part = asset.parts[0]
    broken = dataclasses.replace(part, weights=np.full_like(part.weights, np.nan))
    with pytest.raises(ValueError, match="parts/0/weights is not finite"):
        write_asset(tmp_path / "a.h5", dataclasses.replace(asset, parts=(broken, asset.parts[1])))
    unwritable = dataclasses.replace(asset, provenance={"x": float("nan")})
    with pytest.raises(ValueError, match="JSON compliant"):
        write_asset(tmp_path / "a.h5", unwritable)
    assert list(tmp_path.iterdir()) == []


def test_any_hdf5_reader_finds_values_axes_and_scales(asset: Asset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_asset(path, asset)
    part: Part = asset.parts[0]
    with h5py.File(path) as file:
        bases = file["parts/0/clusters/light_bases"]
        assert bases.attrs["axes"] == b"clusters coeffs light"
        scale = file["parts/0/clusters/" + bases.attrs["scale"].decode()][...]
        plain = (bases[...] - bases.attrs["offset"]) * scale
        assert (bases.compression, bases.shuffle, bases.fletcher32) == ("gzip", True, True)
    assert part.light_bases is not None
    assert np.abs(plain - part.light_bases).max() <= 0.51 * scale.max()
    assert np.abs(plain - part.light_bases).max() > 0.1 * scale.max()
