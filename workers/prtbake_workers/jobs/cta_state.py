"""What the tasks of a fanned-out tensor approximation hand to each other.

The first task leaves the view basis, the initial clusters, and the transfer as raw rows.  A task of
a model step leaves its clusters whole: members, bases and errors.  Those of all its siblings are
the state that the next step begins from; nobody joins them but who reads them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.hdf5.bundle import read_bundle, write_bundle
from prtbake_storage.hdf5.transfer import TransferPart
from prtbake_workers.arrays import F64
from prtbake_workers.compress.classify import Moves
from prtbake_workers.compress.cluster_factors import ClusterFactors
from prtbake_workers.compress.cta_fit import CtaFit, CtaProblem, Fitted, ViewPart
from prtbake_workers.compress.cta_model import CtaRanks
from prtbake_workers.jobs.rows_file import RowsFile

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Started:
    """What the first task found out, as it stands in its result.

    Attributes
    ----------
    rows, state
        Digests of the raw rows, and of their scale, the view basis and the initial clusters.
    n_clusters, ranks
        As the data can fill them.
    squared_norm
        Of the transfer, weighted.
    notes
        What was cut.
    """

    rows: str
    state: str
    n_clusters: int
    ranks: tuple[int, int, int]
    squared_norm: float
    notes: list[str]

    @staticmethod
    def from_dict(data: dict[str, Any]) -> "Started":
        """Read back."""
        return Started(**data | {"ranks": tuple(data["ranks"])})


def write_start(path: Path, fit: CtaFit, rows: RowsFile) -> Path:
    """Write the state before the first model step."""
    arrays: Arrays = {
        "scale": rows.scale,
        "view_basis": fit.view_basis,
        "labels": fit.labels,
        "view_errors": fit.view_errors,
    }
    return write_bundle(path, arrays, {"n_coeffs": rows.shape[2]})


def read_fit(
    store: BlobStore, started: Started, models: Sequence[str], part: TransferPart, **problem: Any
) -> CtaFit:
    """Read the state after the model step whose tasks left ``models``, or before the first.

    ``problem`` are those fields of `CtaProblem` that a request gives.
    """
    arrays, header = read_bundle(store.local_path(started.state))
    transfer = RowsFile(store.local_path(started.rows), arrays["scale"], header["n_coeffs"])
    of_problem = CtaProblem(
        transfer=transfer,
        ranks=CtaRanks(*started.ranks),
        n_clusters=started.n_clusters,
        n_channels=part.n_channels,
        **problem,
    )
    fit = CtaFit(
        of_problem,
        started.squared_norm,
        arrays["view_basis"],
        arrays["labels"],
        arrays["view_errors"],
    )
    for digest in models:
        _read_model(store.local_path(digest), fit)
    return fit


def write_model(path: Path, fit: CtaFit, clusters: Iterable[int], fitted: Sequence[Fitted]) -> Path:
    """Write some clusters after a model step, with their members and the view basis."""
    members = fit.members()
    own = [members[cluster] for cluster in clusters]
    verts = np.concatenate(own)
    arrays: Arrays = {
        "clusters": np.array(list(clusters), np.int64),
        "sizes": np.array([len(one) for one in own], np.int64),
        "verts": verts,
        "errors": np.concatenate([errors for _, errors in fitted]),
        "view_errors": fit.view_errors[verts],
        "view_basis": fit.view_basis,
        "ranks": np.array([(f.light.shape[1], len(f.dual)) for f, _ in fitted], np.int64),
        "light": np.concatenate([factors.light.ravel() for factors, _ in fitted]),
        "dual": np.concatenate([factors.dual.ravel() for factors, _ in fitted]),
    }
    return write_bundle(path, arrays, {}, gzip_level=0)


def _read_model(path: Path, fit: CtaFit) -> None:
    """Take over the clusters that one task of a model step left."""
    arrays, _ = read_bundle(path)
    fit.set_view_basis(arrays["view_basis"])
    verts, n_coeffs = arrays["verts"], fit.z.shape[2]
    fit.labels[verts] = np.repeat(arrays["clusters"], arrays["sizes"])
    fit.errors[verts], fit.view_errors[verts] = arrays["errors"], arrays["view_errors"]
    n_light, n_dual = np.zeros(2, np.int64)
    for r_light, r_vert in arrays["ranks"].tolist():
        of_light = slice(n_light, n_light + n_coeffs * r_light)
        of_dual = slice(n_dual, n_dual + r_vert * fit.z.shape[1] * r_light)
        fit.factors.append(
            ClusterFactors(
                arrays["light"][of_light].reshape(n_coeffs, r_light),
                arrays["dual"][of_dual].reshape(r_vert, fit.z.shape[1] * r_light),
            )
        )
        n_light, n_dual = of_light.stop, of_dual.stop


def write_moves(path: Path, moves: Sequence[Moves]) -> Path:
    """Write who leaves some clusters."""
    names = Moves._fields
    arrays = {name: np.concatenate([getattr(own, name) for own in moves]) for name in names}
    return write_bundle(path, arrays, {}, gzip_level=0)


def read_moves(store: BlobStore, digests: Iterable[str]) -> list[Moves]:
    """Read who leaves which cluster."""
    return [Moves(**read_bundle(store.local_path(digest))[0]) for digest in digests]


def write_view(path: Path, parts: Sequence[ViewPart]) -> Path:
    """Write Gram matrices and vertex bases of some clusters."""
    bases = [part.vertex_basis for part in parts]
    arrays = {
        "grams": np.stack([part.gram for part in parts]),
        "shapes": np.array([basis.shape for basis in bases], np.int64),
        "bases": np.concatenate([basis.ravel() for basis in bases]),
    }
    return write_bundle(path, arrays, {}, gzip_level=0)


def read_view(store: BlobStore, digests: Iterable[str]) -> tuple[list[F64], list[F64]]:
    """Read Gram matrices and vertex bases of all clusters."""
    grams: list[F64] = []
    bases: list[F64] = []
    for digest in digests:
        arrays, _ = read_bundle(store.local_path(digest))
        grams += list(arrays["grams"])
        ends = np.cumsum(arrays["shapes"].prod(axis=1))[:-1]
        pieces = np.split(arrays["bases"], ends)
        bases += [
            piece.reshape(shape) for piece, shape in zip(pieces, arrays["shapes"], strict=True)
        ]
    return grams, bases
