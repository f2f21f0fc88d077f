"""A transfer file of a glossy part and a diffuse one, made up rather than baked."""

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from prtbake_storage.contract.brdf import CookTorranceSpec, LambertSpec
from prtbake_storage.decode.quantise import quantise
from prtbake_storage.decode.transfer_basis import WhitenedSrbfs
from prtbake_storage.hdf5.transfer import (
    TransferHeader,
    TransferPart,
    join_transfer,
    write_transfer_tile,
)
from prtbake_workers.basis.srbf import default_bandwidth
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.icosphere import icosphere
from synthetic_transfer import equal_area_directions, synthetic_transfer

VERTS = (300, 200)
COEFFS = 162


def in_channels(transfer: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Falling channels with noise of their own, 2 % of the root mean square: row c * terms + k."""
    size = 0.02 * np.sqrt(np.mean(transfer.astype(float) ** 2))
    channels = [
        factor * transfer + size * rng.standard_normal(transfer.shape)
        for factor in (1.0, 0.5, 0.25)
    ]
    return np.concatenate(channels, axis=1).astype(np.float32)


def write_transfer(folder: Path, *, n_channels: int, n_terms: int = 7) -> Path:
    """Write ``transfer.h5``: part ``object`` of so many terms or a few less, ``receiver`` of one."""
    path = folder / "transfer.h5"
    path.write_bytes(_transfer(n_channels, n_terms))
    return path


@cache
def _transfer(n_channels: int, n_terms: int) -> bytes:
    """What the file holds: made once, for the many tests that begin with it."""
    with tempfile.TemporaryDirectory() as folder:
        return _written(Path(folder), n_channels, n_terms).read_bytes()


def _written(folder: Path, n_channels: int, n_terms: int) -> Path:
    rng = np.random.default_rng(11)
    brdfs = [CookTorranceSpec(m=0.5), LambertSpec(albedo=0.7)]
    parts, tiles, start = [], [], 0
    for name, spec, verts in zip(("object", "receiver"), brdfs, VERTS, strict=True):
        model = factorise(brdf_from_spec(spec), n_terms=n_terms, n_theta=12, n_phi=32)
        rows = synthetic_transfer(verts, model.n_terms, COEFFS)
        rows = in_channels(rows, rng) if n_channels == 3 else rows
        packed = quantise(rows, (2,))
        tiles.append([folder / f"{name}.h5"])
        write_transfer_tile(
            tiles[-1][0], packed.values, scale=packed.scale[:, :, 0],
            signal_energy=np.sum(rows.astype(float) ** 2, axis=(1, 2)),
            residual_energy=np.zeros(verts),
        )  # fmt: skip
        parts.append(
            TransferPart(
                name=name, vertex_range=(start, start + verts), material=spec.model_dump(),
                areas=rng.uniform(0.5, 2.0, verts), n_terms=model.n_terms, n_channels=n_channels,
                frames=None if model.is_constant_phi else tangent_frames(
                    equal_area_directions(verts)
                ),
                albedo=model.albedo, factorisation=model.tables(),
            )
        )  # fmt: skip
        start += verts
    points = np.concatenate([equal_area_directions(verts) for verts in VERTS])
    centres = icosphere(2)
    header = TransferHeader(
        positions=points, faces=np.array([[0, 1, 2], [300, 301, 302]], np.int32), normals=points,
        uv=None, basis=WhitenedSrbfs(centres, default_bandwidth(COEFFS)), parts=tuple(parts),
    )  # fmt: skip
    path = folder / "transfer.h5"
    join_transfer(path, header, tiles)
    return path
