"""What the parts of a compression share of the bytes and seconds that are asked for."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.hdf5.transfer import TransferHeader, open_transfer
from prtbake_storage.queue.context import TaskContext
from prtbake_workers.compress.methods import Model
from prtbake_workers.deadline import Deadline
from prtbake_workers.planning.byte_budget import Extent, sized_to_bytes
from prtbake_workers.planning.file_bytes import frame_bytes
from prtbake_workers.planning.packed_bytes import packed_bytes
from prtbake_workers.planning.presets import PartCompression
from prtbake_workers.planning.stage_work import compress_work

START_SECONDS = 0.9
"""Of a task's process, of which a part has one and the asset another."""

LEAST_SHARE = 0.1
"""Of what the mesh leaves of bytes that are asked for, that factors are sized for at least."""

READS = 2.5
"""Times that writing and measuring the asset takes what reading the transfer does: 2.2 measured."""

READS_BY_BYTES = 4.5
"""The same where bytes are asked for, and files of several sizes are made: 4.0 measured."""


def budgets(settings: CompressSettings, compressions: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Give the tasks of parts what they share bytes and seconds by, where there is a budget."""
    given: dict[str, Any] = {}
    if settings.max_bytes is not None and settings.max_error is None:
        given |= {
            "max_bytes": settings.max_bytes,
            "clusters_given": settings.n_clusters is not None,
        }
    if settings.max_seconds is not None:
        given |= {"max_seconds": settings.max_seconds, "threads": settings.threads}
    return given | {"compressions": list(compressions)} if given else {}


def planned_fit(
    args: dict[str, Any], context: TaskContext, read_seconds: float
) -> tuple[PartCompression, Deadline | None]:
    """Choose the part's sizes, which may go by bytes, and when its fit has to end."""
    if args.get("compressions") is None:
        return PartCompression.from_dict(args["compression"]), None
    with open_transfer(context.store.local_path(args["transfer"])) as transfer:
        header = transfer.header
    max_bytes = args.get("max_bytes")
    sizes = [PartCompression.from_dict(one) for one in args["compressions"]]
    if max_bytes is not None:
        sizes = sized_to_bytes(
            extents_of(header),
            sizes,
            factor_bytes(max_bytes, header),
            clusters_given=args["clusters_given"],
        )
    own: PartCompression = sizes[args["part"]]
    if args.get("max_seconds") is None:
        return own, None
    seconds = fit_seconds(
        args["max_seconds"],
        header,
        sizes,
        args["part"],
        iterations=args["max_iterations"],
        threads=args["threads"],
        read_seconds=read_seconds,
        by_bytes=max_bytes is not None,
    )
    return own, Deadline(seconds)


def extents_of(header: TransferHeader) -> list[Extent]:
    """Give the shape of every part's transfer."""
    return [
        Extent(part.n_vertices, part.n_terms, header.basis.n_coeffs, part.n_channels)
        for part in header.parts
    ]


def factor_bytes(max_bytes: int, header: TransferHeader) -> float:
    """Give what mesh and file format leave of an asset's bytes.

    Of a small file the format is most, and foretold too roughly to be taken off in full.
    """
    left = float(max_bytes - mesh_bytes(header))
    return max(left - frame_bytes(len(header.parts)), LEAST_SHARE * left)


def mesh_bytes(header: TransferHeader) -> int:
    """Pack mesh and frames as assets hold them."""
    units = np.round(header.normals * 32767.0).astype(np.int16)
    arrays: list[NDArray[Any]] = [header.positions.astype(np.float32), header.faces, units]
    # a tangent packs to about what a normal does
    arrays += [units[slice(*own.vertex_range)] for own in header.parts if own.frames is not None]
    if header.uv is not None:
        arrays.append(header.uv.astype(np.float32))
    return sum(packed_bytes(array) for array in arrays)


def fit_seconds(
    max_seconds: float,
    header: TransferHeader,
    compressions: Sequence[PartCompression],
    part: int,
    *,
    iterations: int,
    threads: int,
    read_seconds: float,
    by_bytes: bool,
) -> float:
    """Share the seconds of all tasks out among the fits, by the operations they are counted at.

    Parameters
    ----------
    max_seconds
        Of all tasks of compressing and writing, added up.
    part
        Whose fit it is.
    iterations, threads
        As the settings have them.
    read_seconds
        That reading this part's transfer took: what is kept for reading and writing goes by it, so
        that it holds on a slow machine or a busy one.
    by_bytes
        Whether the asset is to have a number of bytes.

    Returns
    -------
    float
        From now on; 0 or less where nothing is left for fits.
    """
    values, work = [], []
    for own, compression in zip(extents_of(header), compressions, strict=True):
        counted = compress_work(compression, **asdict(own), iterations=iterations, threads=threads)
        work.append(counted["product_flops"] + counted["solve_flops"])
        values.append(counted["values"])
    reading = read_seconds * sum(values) / max(values[part], 1.0)
    kept = (1.0 + (READS_BY_BYTES if by_bytes else READS)) * reading
    kept += START_SECONDS * (len(work) + 1)
    return (max_seconds - kept) * work[part] / sum(work)


def time_notes(
    name: str, args: dict[str, Any], model: Model, deadline: Deadline | None
) -> list[str]:
    """Say that a fit ended for want of time."""
    if deadline is None or not deadline.hit:
        return []
    return [
        f"{name}: max_seconds {args['max_seconds']:g} ended the fit after {deadline.spent:.1f} s "
        f"and {model.iterations} iterations, with a squared error of "
        f"{model.squared_error_ratio:.2g}"
    ]
