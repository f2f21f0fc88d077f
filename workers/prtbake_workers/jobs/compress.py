"""Job kind ``compress``: the factors of every part, then the asset with them exact and rounded."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.contract.settings import CompressSettings, Quality
from prtbake_storage.decode.asset import Asset, Part
from prtbake_storage.hdf5.bundle import read_bundle
from prtbake_storage.hdf5.transfer import TransferHeader, TransferPart, open_transfer
from prtbake_storage.hdf5.writer import write_asset
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Rounds, Stage, Task
from prtbake_workers.arrays import F64
from prtbake_workers.brdf.stored_factorisation import factorisation_from_tables
from prtbake_workers.brdf.view_texture import ERROR_TOLERANCE, fit_view_texture
from prtbake_workers.compress.methods import compress
from prtbake_workers.compress.rows import Rows
from prtbake_workers.compress.superclusters import (
    make_superclusters,
    registers_of_clusters,
)
from prtbake_workers.compress.to_error import compress_to_error
from prtbake_workers.deadline import ends_by
from prtbake_workers.jobs.cta_course import OneTask, SharedSteps, course, most_rounds
from prtbake_workers.jobs.inputs import versions
from prtbake_workers.jobs.part_budget import budgets, planned_fit, time_notes
from prtbake_workers.jobs.part_fit import part_fit, part_result
from prtbake_workers.jobs.pointing import pointing_at
from prtbake_workers.jobs.rounding import options
from prtbake_workers.jobs.rows_file import write_rows
from prtbake_workers.jobs.sized import write_asked
from prtbake_workers.percent import percent
from prtbake_workers.planning.cost import HELD_BYTES, factor_floats
from prtbake_workers.planning.expected_sizes import expected_sizes
from prtbake_workers.planning.presets import PartCompression, resolve_compression
from prtbake_workers.planning.registers import check_planned_registers
from prtbake_workers.planning.search_work import searched_work
from prtbake_workers.planning.stage_work import quantise_work, total
from prtbake_workers.planning.uncounted import untaught

_MODULE = "prtbake_workers.jobs.compress"
ROUNDING_SHARE = 0.1
"""Of an error that is asked for: a tenth in place of a hundredth saves a quarter of the bytes."""

SHARE_OF_16_BITS = 0.01
"""The same where the settings have 16 bits: they add some 1e-8 of the transfer."""

READ_VERTS = 2048
"""Vertices read at a time, so that 16-bit and 32-bit copies do not lie side by side in full."""


def stages(
    plan_of: Callable[[Results], tuple[str, list[dict[str, Any]]]],
    settings: CompressSettings,
    seed: int,
    *,
    settings_at: str = "/settings/compress",
    started: float | None = None,
    held_to: int | None = None,
) -> list[Stage]:
    """Compress each part in a task of its own, or in rounds of tasks, then write the asset.

    ``plan_of`` gives the transfer's digest and each part's compression from earlier results,
    ``settings_at`` is the JSON pointer to the settings in the request, ``started`` the job's start
    in seconds since 1970: what `max_seconds` cuts belongs to this job.  A file of the settings'
    sizes that takes more than ``held_to`` bytes is cut to them.
    """
    rounding, draws = options(settings), draw_settings(settings)
    kept = ROUNDING_SHARE if settings.bits == "auto" else SHARE_OF_16_BITS

    def parts(results: Results) -> list[OneTask | SharedSteps]:
        transfer, compressions = plan_of(results)
        wholes = [
            Task(
                f"{_MODULE}:compress_part",
                {
                    "transfer": transfer,
                    "part": index,
                    "compression": _made(compression),
                    "max_iterations": settings.max_iterations,
                    "max_error": settings.max_error,
                    "kept": kept,
                    "seed": seed,
                    "draws": draws,
                }
                | budgets(settings, compressions),
                label=f"part {index}",
                threads=settings.threads,
                settings_at=settings_at,
                job_started=None if settings.max_seconds is None else started,
            )
            for index, compression in enumerate(compressions)
        ]
        n_tasks = [compression["tasks"] for compression in compressions]
        return course(wholes, n_tasks, results.rounds("compress"))

    def most(results: Results) -> int:
        shared = any(compression["tasks"] > 1 for compression in plan_of(results)[1])
        return most_rounds(settings.max_iterations) if shared else 1

    def assemble(results: Results) -> list[Task]:
        transfer, compressions = plan_of(results)
        asked = settings.model_dump(include={"max_iterations", "max_error", "threads"})
        limits = settings.model_dump(include={"max_bytes", "max_seconds"}, exclude_none=True)
        limits |= {} if held_to is None else {"max_bytes": held_to}
        args = {
            "transfer": transfer,
            "factors": [result["factors"] for result in results["compress"]],
            "left": [result["errors"][result["name"]] for result in results["compress"]],
            "energies": [result["initial_energy"] for result in results["compress"]],
            "rounding": rounding,
            "max_error": settings.max_error,
            "max_bytes": settings.max_bytes,
            "held_to": held_to,
            "registers": settings.registers,
            "compress": asked
            | limits
            | draws
            | {"seed": seed}
            | rounding
            | {"parts": list(map(_made, compressions))},
        }
        return [Task(f"{_MODULE}:assemble", args, settings_at=settings_at)]

    return [
        Stage(
            "compress",
            "parts",
            30.0,
            lambda results: [task for part in parts(results) for task in part.tasks()],
            Rounds(most, lambda results: [part.result or {} for part in parts(results)]),
        ),
        Stage("quantise", "asset", 2.0, assemble),
    ]


def _made(compression: dict[str, Any]) -> dict[str, Any]:
    """Leave out how many tasks make the steps: it is no part of what is made."""
    return {name: value for name, value in compression.items() if name != "tasks"}


def standalone_stages(
    transfer: str,
    settings: CompressSettings,
    seed: int,
    *,
    quality: Quality = "medium",
    started: float | None = None,
) -> list[Stage]:
    """Compress an earlier job's transfer: look at its parts first, then as in an asset job.

    ``quality`` gives the sizes that the settings leave to planning.
    """
    dumped = settings.model_dump(mode="json")
    args = {"transfer": transfer, "settings": dumped, "quality": quality}

    def outline(_: Results) -> list[Task]:
        return [Task(f"{_MODULE}:outline", args, label="outline")]

    def plan_of(results: Results) -> tuple[str, list[dict[str, Any]]]:
        parts = results["plan"][0]["plan"]["parts"]
        return transfer, [part["compression"] for part in parts]

    return [
        Stage("plan", "plan", 1.0, outline),
        *stages(plan_of, settings, seed, settings_at="/settings", started=started),
    ]


@pointing_at(CompressSettings)
def outline(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: choose method, clusters and ranks of each part of a transfer file."""
    settings = CompressSettings.model_validate(args["settings"])
    with open_transfer(context.store.local_path(args["transfer"])) as transfer:
        header = transfer.header
    compressions = compressions_of(header, settings, args["quality"])
    parts = [
        {
            "name": part.name,
            "role": part.role,
            "vertex_range": part.vertex_range,
            "n_terms": part.n_terms,
            "tiles": [],
            "compression": asdict(compression),
        }
        for part, compression in zip(header.parts, compressions, strict=True)
    ]
    plan = {
        "parts": parts,
        "effects": header.provenance.get("effects", []),
        "bounces": None,
        "notes": [],
        "work": work_of(header, settings, compressions),
        "uncounted": sorted(untaught(settings)),
    }
    return {"plan": plan}


def compressions_of(
    header: TransferHeader, settings: CompressSettings, quality: Quality = "medium"
) -> list[PartCompression]:
    """Choose each part's method, clusters and ranks, of a compress job; refuse by registers."""
    found = [
        resolve_compression(
            settings,
            quality,
            n_verts=part.n_vertices,
            n_terms=part.n_terms,
            n_coeffs=header.basis.n_coeffs,
            n_channels=part.n_channels,
            singular_values=spectrum_of(part),
        )
        for part in header.parts
    ]
    for part, own in zip(header.parts, found, strict=True):
        check_planned_registers(
            settings,
            part.name,
            own,
            n_verts=part.n_vertices,
            n_terms=part.n_terms,
            settings_at="/settings",
        )
    return found


def work_of(
    header: TransferHeader, settings: CompressSettings, compressions: Sequence[PartCompression]
) -> dict[str, dict[str, float]]:
    """Count the work of compressing a transfer file and writing its asset."""
    fits, quantise = [], []
    for part, compression in zip(header.parts, compressions, strict=True):
        size = {
            "n_verts": part.n_vertices,
            "n_terms": part.n_terms,
            "n_coeffs": header.basis.n_coeffs,
            "n_channels": part.n_channels,
        }
        fits.append(searched_work(compression, settings, **size))
        own = expected_sizes(compression, settings.max_error, **size)
        quantise.append(quantise_work(own, **size, factor_floats=factor_floats(own, **size)))
    return {
        "plan": {"outlines": 1.0},
        "compress": total(fits),
        "quantise": total([{"tasks": 1.0}, *quantise]),
    }


def draw_settings(settings: CompressSettings) -> dict[str, Any]:
    """Give the settings that say how often triangles are drawn, those that are set."""
    given = settings.model_dump(mode="json", include={"coherence", "overdraw_budget", "registers"})
    return {name: value for name, value in given.items() if value is not None}


def spectrum_of(part: TransferPart) -> F64 | None:
    """Give the singular values of a part's BRDF; None where the file holds no factorisation."""
    values = (part.factorisation or {}).get("singular_values")
    return None if values is None else np.asarray(values, np.float64)


def read_coefficients(
    path: Path, part: int, scratch: Path | None = None
) -> tuple[TransferPart, Rows]:
    """Read the whitened coefficients of a part as float32 (verts, rows, coeffs).

    Given a folder, those that take more than `HELD_BYTES` are unpacked into a file there.
    """
    with open_transfer(path) as transfer:
        own = transfer.header.parts[part]
        n_coeffs = transfer.header.basis.n_coeffs
        if scratch is not None and 4 * own.n_vertices * own.n_rows * n_coeffs > HELD_BYTES:
            return own, write_rows(scratch / f"part-{part}.rows", transfer, part)
        coefficients = np.zeros((own.n_vertices, own.n_rows, n_coeffs), np.float32)
        for start in range(0, own.n_vertices, READ_VERTS):
            stop = min(start + READ_VERTS, own.n_vertices)
            coefficients[start:stop] = transfer.read(part, start, stop)
    return own, coefficients


@pointing_at(CompressSettings)
def compress_part(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: compress one part, its vertices weighted by area."""
    began = time.monotonic()
    part, coefficients = read_coefficients(
        context.store.local_path(args["transfer"]),
        args["part"],
        context.scratch if args["compression"]["method"] == "cta" else None,
    )
    compression, deadline = planned_fit(args, context, time.monotonic() - began)
    fit, faces = part_fit(args, context, part, compression.classification)
    inputs = compression.method, coefficients, compression, fit
    with ends_by(deadline):
        if args.get("max_error") is None:
            compressed = compress(*inputs)
        else:
            compressed = compress_to_error(*inputs, args["max_error"], kept=args["kept"])
    result = part_result(compressed, part, coefficients.nbytes, faces, args, context)
    late = time_notes(part.name, args, compressed.model, deadline)
    return result | {"notes": result["notes"] + late}


@pointing_at(CompressSettings)
def assemble(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: write ``asset.h5`` and, with exact factors, ``asset-float32.h5``."""
    with open_transfer(context.store.local_path(args["transfer"])) as transfer:
        header = transfer.header
        parts: list[Part] = []
        errors: dict[str, float] = {}
        notes: list[str] = []
        for index, digest in enumerate(args["factors"]):
            arrays, factors = read_bundle(context.store.local_path(digest))
            part, view_error = make_part(header.parts[index], factors["method"], arrays)
            parts.append(part)
            if part.view_texture is None:
                continue
            # squared, as all errors of stages are
            errors[f"{part.name} view texture"] = view_error**2
            if view_error > ERROR_TOLERANCE:
                side = len(part.view_texture)
                notes.append(
                    f"{part.name}: the view texture of {side} x {side} texels is off by "
                    f"{percent(view_error)} of the radiance: the lobe is narrow for it"
                )
        exact = make_asset(header, tuple(parts), args["compress"], source=args["transfer"])
        exact_path, path = context.scratch / "asset-float32.h5", context.scratch / "asset.h5"

        def finished(asset: Asset) -> Asset:
            registers = args["registers"]
            return asset if registers is None else with_superclusters(asset, registers)

        exact, rounded, delivered = write_asked(path, exact, transfer, args, finished)
        write_asset(exact_path, exact, bits=32)
    size = path.stat().st_size
    return {
        "asset": context.store.put_file(path, move=True),
        "exact": context.store.put_file(exact_path, move=True),
        "bytes": size,
        "groups": rounded.asset.nbytes,
        "overdraw": exact.overdraw,
        "precision": [asdict(part.precision) for part in rounded.asset.parts if part.precision],
        "superclusters": [
            None
            if part.superclusters is None
            else {
                "count": part.superclusters.n_superclusters,
                "overdraw": len(part.superclusters.indices) / max(1, len(exact.faces_of(index))),
            }
            for index, part in enumerate(exact.parts)
        ],
        "delivered": delivered,
        "errors": errors | rounded.errors,
        "notes": notes + rounded.notes,
    }


def make_part(
    part: TransferPart, method: Any, arrays: dict[str, NDArray[Any]]
) -> tuple[Part, float]:
    """Join a part's surface with its factors; also the view texture's error, 0 without one."""
    texture, error = None, 0.0
    factors: dict[str, Any] = dict(arrays)
    factorisation = factorisation_from_tables(part.factorisation or {})
    if not factorisation.is_constant_phi:
        phi, error = fit_view_texture(factorisation)
        texture = np.einsum("abkc,kr->abrc", phi, arrays["view_basis"]).astype(np.float32)
    joined = Part(
        name=part.name,
        role=part.role,
        two_sided=part.two_sided,
        vertex_range=part.vertex_range,
        material=part.material,
        method=method,
        albedo=part.albedo,
        albedo_texture=part.albedo_texture,
        vertex_colours=part.vertex_colours,
        view_texture=texture,
        frames=None if part.frames is None else part.frames.astype(np.float32),
        factorisation=part.factorisation,
        n_channels=part.n_channels,
        precision=None,
        **factors,
    )
    return joined, error


def make_asset(
    header: TransferHeader, parts: tuple[Part, ...], compress: dict[str, Any], *, source: str
) -> Asset:
    """Join mesh, basis and parts; ``compress`` says how the factors were made."""
    return Asset(
        positions=header.positions.astype(np.float32),
        faces=header.faces,
        normals=header.normals.astype(np.float32),
        uv=None if header.uv is None else header.uv.astype(np.float32),
        parts=parts,
        basis=header.basis,
        provenance=dict(header.provenance)
        | {"transfer": source, "compress": compress | {"versions": versions()}},
    )


def with_superclusters(asset: Asset, registers: int) -> Asset:
    """Give every part index buffers for a renderer of so many registers."""
    parts = tuple(
        replace(
            part,
            superclusters=make_superclusters(
                asset.faces_of(index),
                part.labels,
                registers_of_clusters(part.ranks, with_mean=part.means is not None),
                registers,
                first_vertex=part.vertex_range[0],
            ),
        )
        for index, part in enumerate(asset.parts)
    )
    return replace(asset, parts=parts)
