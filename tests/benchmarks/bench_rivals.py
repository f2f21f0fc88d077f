"""Beside what others use: LBG and scikit-learn's KMeans, CTA with rounding and SZ3 and zfp.

Clusters are those of the first term of the bunny's transfer, from the same seeds in as many
iterations.  Compressors are given 4,096 of its vertices with all terms and coefficients, and judged
by bytes at the same squared-error ratio against the same float32 numbers: for CTA the bytes of the
part in an asset file, labels and scales included, and the error of what the file reads back as; for
the others their best of several layouts and predictors.  Their bytes at exactly that error are
read off the line between two runs, one on either side of it.

SZ3's relative, PSNR and L2 modes only derive its absolute bound from the data, so the absolute one
stands for all.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
from bench_compress import FULL, QUICK
from harness import Row, best_time, in_child
from numpy.typing import NDArray

from prtbake_storage.decode.asset import Asset, Part
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.decode.transfer_basis import WhitenedSrbfs
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.writer import write_asset
from prtbake_workers.compress.bit_allocation import allocate_bits
from prtbake_workers.compress.lbg import lbg
from prtbake_workers.compress.methods import Fit
from prtbake_workers.compress.parallel import same_bytes_on_any_threads
from prtbake_workers.compress.to_error import Scaled, compress_to_error
from prtbake_workers.geometry.icosphere import icosphere

F32 = NDArray[np.float32]
SEED = 0
LBG_ITERATIONS = 20
REPEATS = 5
SAME_ERROR = 1.001
TILE = 4096
ERRORS = {0.3: 2, 0.2: 2, 0.1: 4, 0.05: 8, 0.02: 24}
"""Squared-error ratios asked for, and the clusters of each."""

ROUNDING_SHARE = 0.1
ROOM = 0.995
"""Of an error that is asked for, as jobs leave for rounding and fill."""

BANDWIDTH = 10.0
"""Of the file's basis, which no byte that is counted depends on."""

NEAR = 1.1
"""Ratio of the two errors between which a compressor's bytes are read off, where it has such."""

MOST_RUNS = 12
Coded = Callable[[float], tuple[int, F32]]
"""Takes a bound on the absolute error, gives bytes and what they decode to."""


def rows(quick: bool) -> list[Row]:
    """Return the table of this benchmark."""
    with TemporaryDirectory() as folder:
        path = str(Path(folder) / "transfer.npy")
        made = in_child("bench_compress.py", "make_transfer", quick=quick, path=path)
        both = in_child(__file__, "measure_clusters", quick=quick, path=path)
        found = [
            in_child(__file__, "measure_bytes", quick=quick, path=path, target=target)
            for target in ([0.1] if quick else ERRORS)
        ]
    ours, kmeans = both["ours"], both["kmeans"]
    size = f"{made['what']}, {both['what']}"
    table = [
        Row(
            f"KMeans, {LBG_ITERATIONS} iterations",
            seconds=kmeans["lloyd"],
            error=kmeans["error"],
            limit_description=f"scikit-learn, {size}; the same seeds, given to it",
        ),
        Row(
            "KMeans, Elkan's",
            seconds=kmeans["elkan"],
            error=kmeans["error"],
            limit_description="scikit-learn's other algorithm",
        ),
        Row(
            f"LBG, {LBG_ITERATIONS} iterations",
            seconds=ours["seconds"],
            measured=ours["seconds"] / kmeans["lloyd"],
            unit="of KMeans",
            limit=None if quick else 1.0,
            error=ours["error"],
            limit_description="KMeans as it is by default; seeding included",
        ),
        Row(
            "LBG, error",
            measured=ours["error"] / kmeans["error"],
            unit="of KMeans'",
            limit=SAME_ERROR,
            error=ours["error"],
            limit_description="to the nearest of the last means, both",
        ),
    ]
    for one in found:
        best = min(one["theirs"], key=one["theirs"].get)
        others = ", ".join(f"{name} {n / 1000:,.0f} kB" for name, n in one["theirs"].items())
        table.append(
            Row(
                f"CTA and rounding, {one['target']:.0%} asked",
                seconds=one["seconds"],
                measured=one["ours"] / one["theirs"][best],
                unit=f"of {best}",
                limit=1.0,
                error=one["error"],
                limit_description=f"{one['ours'] / 1000:,.1f} kB beside {others}",
            )
        )
    return table


def measure_clusters(*, quick: bool, path: str) -> dict[str, Any]:
    """Time LBG, seeding included, and KMeans from the seeds that it draws: in turns, the shortest."""
    from sklearn.cluster import KMeans

    signal = np.load(path, mmap_mode="r")[:, 0].copy()
    n_clusters = (QUICK if quick else FULL).n_clusters

    def means(n_iterations: int) -> F32:
        with same_bytes_on_any_threads():
            return lbg(
                signal, n_clusters, rng=np.random.default_rng(SEED), weights=np.ones(len(signal)),
                max_iterations=n_iterations, tolerance=0.0,
            ).means  # fmt: skip

    # no iteration: the seeds themselves
    seeds = means(0)

    def theirs(algorithm: str) -> F32:
        model = KMeans(
            n_clusters, init=seeds, n_init=1, max_iter=LBG_ITERATIONS, tol=0.0, algorithm=algorithm
        )
        return model.fit(signal).cluster_centers_.astype(np.float32)

    works = {
        "ours": lambda: means(LBG_ITERATIONS),
        "lloyd": lambda: theirs("lloyd"),
        "elkan": lambda: theirs("elkan"),
    }
    # the first time of each loads what it needs
    found = {name: work() for name, work in works.items()}
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(REPEATS):
        for name, work in works.items():
            times[name].append(best_time(work, repeats=1))
    best = {name: min(taken) for name, taken in times.items()}
    return {
        "what": f"{len(signal)} x {signal.shape[1]}, {n_clusters} clusters",
        "ours": {"seconds": best["ours"], "error": _nearest(signal, found["ours"])},
        "kmeans": {
            "lloyd": best["lloyd"], "elkan": best["elkan"],
            "error": _nearest(signal, found["lloyd"]),
        },
    }  # fmt: skip


def measure_bytes(*, quick: bool, path: str, target: float) -> dict[str, Any]:
    """Compress to an error, then read off what the others take for the same."""
    transfer = np.load(path, mmap_mode="r")[:TILE].copy()
    start = time.perf_counter()
    n_bytes, error = _ours(transfer, target)
    seconds = time.perf_counter() - start
    rivals = {"SZ3": _sz3(transfer), "zfp": _zfp(transfer)}
    theirs = {
        name: min(_bytes_at(coded, transfer, error) for coded in ways)
        for name, ways in rivals.items()
    }
    return {
        "target": target, "seconds": seconds, "error": error, "ours": n_bytes, "theirs": theirs
    }  # fmt: skip


def _nearest(signal: F32, means: F32) -> float:
    """Return the squared distances to the nearest of the means over the squared norm."""
    wide, points = signal.astype(np.float64), means.astype(np.float64)
    squares = np.einsum("vj,vj->v", wide, wide)
    distances = squares[:, None] - 2.0 * wide @ points.T + np.einsum("cj,cj->c", points, points)
    return float(distances.min(axis=1).sum() / squares.sum())


def _ours(transfer: F32, target: float) -> tuple[int, float]:
    """Return the bytes of the part in an asset's file, and the error of what is read back."""
    sizes = Scaled(ERRORS[target], (4, 8, 8), 0)
    fit = Fit(seed=SEED, max_iterations=6)
    found = compress_to_error("cta", transfer, sizes, fit, target, kept=ROUNDING_SHARE)
    n_verts = len(transfer)
    part = Part(
        name="object", vertex_range=(0, n_verts), material={}, method="cta",
        albedo=np.ones(1, np.float32), **found.factors,
        # what turns view columns into radiance is no part of the transfer
        view_texture=np.zeros((2, 2, found.model.view_basis.shape[1], 1), np.float32),
        frames=np.tile(np.eye(3, dtype=np.float32), (n_verts, 1, 1)),
    )  # fmt: skip
    areas = np.ones(n_verts)
    energy = found.model.initial_energy
    room = (ROOM * target - found.model.squared_error_ratio) * energy
    scales = allocate_bits(part, areas, room).scales
    asset = Asset(
        positions=np.zeros((n_verts, 3), np.float32), faces=np.array([[0, 1, 2]], np.int32),
        normals=np.tile(np.array([0.0, 0.0, 1.0], np.float32), (n_verts, 1)), uv=None,
        parts=(part,), basis=WhitenedSrbfs(icosphere(3 if transfer.shape[2] == 642 else 2), BANDWIDTH),
    )  # fmt: skip
    with TemporaryDirectory() as folder:
        path = Path(folder) / "asset.h5"
        write_asset(path, asset, bits=[scales])
        with h5py.File(path) as file:
            group = file["parts/0"]
            owned = [group["weights"], group["weights_scale"], group["view_basis"]]
            owned += group["clusters"].values()
            n_bytes = sum(one.id.get_storage_size() for one in owned)
        seen = read_asset(path)
    return n_bytes, _error(reconstruct(seen.parts[0], slice(0, n_verts)), transfer)


def _error(decoded: F32, transfer: F32) -> float:
    off = decoded - transfer
    squares = np.einsum("vkl,vkl->", off, off, dtype=np.float64)
    return float(squares / np.einsum("vkl,vkl->", transfer, transfer, dtype=np.float64))


def _layouts(transfer: F32) -> dict[str, tuple[F32, Callable[[F32], F32]]]:
    """Return the tensor as others may like it, and the way back."""
    shape = transfer.shape
    terms_first = np.ascontiguousarray(transfer.transpose(1, 0, 2))
    verts_last = np.ascontiguousarray(transfer.transpose(1, 2, 0))
    return {
        "1-D": (transfer.reshape(-1), lambda y: y.reshape(shape)),
        "2-D": (transfer.reshape(len(transfer), -1), lambda y: y.reshape(shape)),
        "3-D": (transfer, lambda y: y),
        "terms first": (terms_first, lambda y: y.transpose(1, 0, 2)),
        "vertices last": (verts_last, lambda y: y.transpose(2, 0, 1)),
    }


def _sz3(transfer: F32) -> list[Coded]:
    """Return ways to use SZ3: predictors by layouts, those that came near the best."""
    from pysz import sz, szAlgorithm, szConfig, szErrorBoundMode

    layouts = _layouts(transfer)

    def coded(layout: str, predictor: str) -> Coded:
        values, back = layouts[layout]

        def run(bound: float) -> tuple[int, F32]:
            config = szConfig()
            config.errorBoundMode = szErrorBoundMode.ABS
            config.absErrorBound = bound
            config.cmprAlgo = getattr(szAlgorithm, predictor)
            data, _ = sz.compress(values, config)
            decoded, _ = sz.decompress(data, values.dtype, values.shape)
            return data.nbytes, back(decoded)

        return run

    return [
        coded(layout, predictor)
        for layout, predictor in (
            ("1-D", "NOPRED"), ("terms first", "NOPRED"), ("vertices last", "NOPRED"),
            ("2-D", "LORENZO_REG"), ("2-D", "INTERP_LORENZO"),
        )
    ]  # fmt: skip


def _zfp(transfer: F32) -> list[Coded]:
    """Return ways to use zfp: its fixed accuracy on layouts."""
    import zfpy

    def coded(values: F32, back: Callable[[F32], F32]) -> Coded:
        def run(bound: float) -> tuple[int, F32]:
            # a tolerance is kept with room: errors are some eighths of it
            data = zfpy.compress_numpy(values, tolerance=4.0 * bound)
            return len(data), back(zfpy.decompress_numpy(data))

        return run

    layouts = _layouts(transfer)
    return [coded(*layouts[name]) for name in ("1-D", "2-D", "3-D")]


def _bytes_at(coded: Coded, transfer: F32, error: float) -> float:
    """Read off the bytes at an error, on the line of logarithms between two runs."""
    rms = np.sqrt(np.mean(np.square(transfer, dtype=np.float64)))
    bound = rms * 8.0 * np.sqrt(error)
    under: tuple[float, float, float] | None = None
    over: tuple[float, float, float] | None = None
    for _ in range(MOST_RUNS):
        n_bytes, decoded = coded(float(bound))
        run = (float(np.log(bound)), float(np.log(_error(decoded, transfer))), np.log(n_bytes))
        if run[1] <= np.log(error):
            under = run
        else:
            over = run
        if under is None or over is None:
            bound *= 1.5 if over is None else 1.0 / 1.5
            continue
        # zfp knows powers of two only: nothing lies between two of them
        if over[1] - under[1] <= np.log(NEAR) or over[0] - under[0] < 0.02:
            break
        share = (np.log(error) - under[1]) / (over[1] - under[1])
        step = min(0.9, max(0.1, share)) * (over[0] - under[0])
        bound = np.exp(under[0] + step)
    if under is None or over is None:
        raise RuntimeError("no bound on either side of the error was found")
    share = (np.log(error) - under[1]) / (over[1] - under[1])
    return float(np.exp(under[2] + share * (over[2] - under[2])))


if __name__ == "__main__":
    sys.exit("run.py runs this")
