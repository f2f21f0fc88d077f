"""Task ``measure``: what an attempt errs by, at views that its validation does not look at."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.decode.asset import Asset
from prtbake_storage.decode.relight import rotation_matrix
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5.bundle import read_bundle, write_bundle
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import TransferHeader, TransferPart, open_transfer
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.arrays import F32
from prtbake_workers.jobs.compress import make_asset, make_part
from prtbake_workers.jobs.lights import LightSource
from prtbake_workers.jobs.validate import MEMORY_BYTES, assemble
from prtbake_workers.validation.hits import trace_camera
from prtbake_workers.validation.tuning import (
    TunedReference,
    attempted_pictures,
    compressed_picture,
    tuned_references,
)

_MODULE = "prtbake_workers.jobs.tuning"
N_CAMERAS = 4
TURNS_A_CAMERA = 2
AZIMUTHS = (45.0, -50.0, 130.0, -140.0)
"""Degrees from a validation's camera to a tuning one."""

ELEVATIONS = (-8.0, 12.0, 6.0, -5.0)
SWING = 0.25
"""Of the azimuths, where a camera's eye is given: it may stand in a room."""

FIRST_TURN, TURN = 21.0, 45.0
"""Degrees about y of the light's first turn, and between turns: none is 0, as validations have."""

WIDTH, HEIGHT = 64, 48
"""Light samples are shared by all pixels: more of those tell little more."""

PASSES, SAMPLES = 8, 64
NOISE_SHARE = 0.3
"""Of an error that is aimed at, that the noise of a reference may be."""


def tuning_views(
    settings: ValidateSettings,
) -> list[tuple[Camera, list[tuple[float, float, float]]]]:
    """Choose cameras around those of a validation, each with turns of the light of its own."""
    views = []
    for index in range(N_CAMERAS):
        own = settings.cameras[index % len(settings.cameras)]
        turns = [
            FIRST_TURN + TURN * (TURNS_A_CAMERA * index + turn) for turn in range(TURNS_A_CAMERA)
        ]
        views.append((_moved(own, index), [(0.0, _other(angle, settings), 0.0) for angle in turns]))
    return views


def _moved(camera: Camera, index: int) -> Camera:
    """Move a camera about what it looks at; one without a target is left where it stands."""
    name = f"tuning-{index}"
    if camera.eye is None:
        elevation = camera.elevation_deg + ELEVATIONS[index]
        return camera.model_copy(
            update={
                "name": name,
                "azimuth_deg": camera.azimuth_deg + AZIMUTHS[index],
                "elevation_deg": min(max(elevation, -80.0), 80.0),
            }
        )
    if camera.target is None:
        return camera.model_copy(update={"name": name})
    turn = rotation_matrix((0.0, SWING * AZIMUTHS[index], 0.0))
    offset = turn @ (np.array(camera.eye) - np.array(camera.target))
    eye = tuple(float(value) for value in np.array(camera.target) + offset)
    return camera.model_copy(update={"name": name, "eye": eye})


def _other(angle: float, settings: ValidateSettings) -> float:
    """Keep off the validation's own turns about y."""
    taken = [turn[1] for turn in settings.rotations_deg]
    while any(abs((angle - one + 180.0) % 360.0 - 180.0) < 1.0 for one in taken):
        angle += 3.0
    return angle


def stage(
    name: str,
    inputs_of: Callable[[Results], dict[str, Any] | None],
    environment: LightSource,
    settings: ValidateSettings,
    max_error: float,
    seed: int,
) -> Stage:
    """One task a camera; ``inputs_of`` gives digests, or None where there is nothing to measure.

    These are transfer and light, asset where there is one, and ``references``: those that an
    earlier measure left, by camera.
    """

    def cameras(results: Results) -> list[Task]:
        inputs = inputs_of(results)
        if inputs is None:
            return []
        given = {key: value for key, value in inputs.items() if key != "references"}
        references = inputs.get("references") or [None] * N_CAMERAS
        return [
            Task(
                f"{_MODULE}:measure",
                {
                    **given,
                    "environment": environment,
                    "camera": camera.model_dump(mode="json"),
                    "rotations": rotations,
                    "bounces": settings.bounces,
                    "noise": NOISE_SHARE * max_error,
                    "seed": seed + 7000 + 100 * index,
                    "reference": reference,
                },
                label=camera.name,
                memory_bytes=MEMORY_BYTES,
            )
            for index, ((camera, rotations), reference) in enumerate(
                zip(tuning_views(settings), references, strict=True)
            )
        ]

    return Stage(name, "views", 5.0, cameras)


def measure(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: hold pictures of an attempt against the reference, which the first makes.

    Its ``views`` say of each turn of the light ``squared_norm`` and ``variance`` of the reference,
    and ``squared`` differences by picture, that variance in them.
    """
    camera = Camera.model_validate(args["camera"])
    with open_transfer(context.store.local_path(args["transfer"])) as transfer:
        header = transfer.header
    asset = None
    if "asset" in args:
        asset = read_asset(context.store.local_path(args["asset"]))
    surfaces = surfaces_of(header) if asset is None else asset
    validation = assemble(args, context.store, header, delivered=surfaces, exact=None)
    settings = ValidateSettings(
        width=WIDTH, height=HEIGHT, passes=PASSES, samples=SAMPLES, bounces=args["bounces"]
    )
    hits = trace_camera(validation, camera, WIDTH, HEIGHT)
    rotations = [rotation_matrix(angles) for angles in args["rotations"]]
    digest, lines = args["reference"], []
    if digest is None:
        references, budgets = tuned_references(
            validation, hits, rotations, settings, noise=args["noise"], seed=args["seed"]
        )
        lines = [{line.name: line.error for line in budget.lines} for budget in budgets]
        path = context.scratch / "references.h5"
        write_bundle(
            path,
            {f"{turn}": reference.mean for turn, reference in enumerate(references)},
            {
                "variance": [reference.variance for reference in references],
                "samples": [reference.samples for reference in references],
            },
        )
        digest = context.store.put_file(path, move=True)
    else:
        references = read_references(context, digest, len(rotations), len(hits.pixels))
    views = []
    for turn, (rotation, reference) in enumerate(zip(rotations, references, strict=True)):
        if asset is None:
            pictures = dict(attempted_pictures(validation, hits, rotation))
        else:
            pictures = {"asset": compressed_picture(validation, asset, hits, rotation)}
        views.append(
            {
                "squared_norm": reference.squared_norm,
                "variance": reference.variance,
                "samples": reference.samples,
                "squared": {
                    name: reference.squared_difference(picture)
                    for name, picture in pictures.items()
                },
                "lines": lines[turn] if lines else {},
            }
        )
    return {"views": views, "reference": digest}


def read_references(
    context: TaskContext, digest: str, n_turns: int, n_hits: int
) -> list[TunedReference]:
    """Read references, and see that they are of pictures of as many pixels."""
    arrays, header = read_bundle(context.store.local_path(digest))
    references = [
        TunedReference(arrays[f"{turn}"], header["variance"][turn], header["samples"][turn])
        for turn in range(n_turns)
    ]
    if any(len(reference.mean) != n_hits for reference in references):
        raise CorruptArtefact(f"the references {digest} are of another scene")
    return references


def surfaces_of(header: TransferHeader) -> Asset:
    """Make an asset of a transfer that has its surfaces, and no light: one black cluster a part."""
    parts = tuple(
        make_part(part, "vq", _dark(part, header.basis.n_coeffs))[0] for part in header.parts
    )
    return make_asset(header, parts, {}, source="")


def _dark(part: TransferPart, n_coeffs: int) -> dict[str, Any]:
    dims = part.n_rows * n_coeffs
    dark: Sequence[F32] = [
        np.zeros(shape, np.float32) for shape in ((part.n_vertices, 0), (1, dims), (1, 0, dims))
    ]
    weights, means, components = dark
    return {
        "labels": np.zeros(part.n_vertices, np.int32),
        "weights": weights,
        "means": means,
        "components": components,
        "ranks": np.array([[part.n_terms, n_coeffs, 0]], np.int32),
        "view_basis": np.eye(part.n_terms, dtype=np.float32),
    }
