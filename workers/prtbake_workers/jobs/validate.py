"""Job kind ``validate``: the chain of pictures of every camera, metrics, and the pictures."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.decode.asset import Asset
from prtbake_storage.decode.relight import rotation_matrix
from prtbake_storage.errors import InputError
from prtbake_storage.hdf5.light import read_light
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.schema import transfer_chunk_vertices
from prtbake_storage.hdf5.transfer import TransferHeader, TransferPart, open_transfer
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.arrays import F32, F64, I64
from prtbake_workers.basis.incident import basis_of
from prtbake_workers.brdf.stored_factorisation import factorisation_from_tables
from prtbake_workers.brdf.view_texture import view_texture
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.mesh import vertex_areas
from prtbake_workers.geometry.scene import Scene, bodies_of
from prtbake_workers.jobs.inputs import load_brdf
from prtbake_workers.jobs.lights import LightSource, load_light
from prtbake_workers.jobs.media import make_dipole
from prtbake_workers.jobs.scene_file import occluder_accelerator
from prtbake_workers.render.images import (
    auto_exposure,
    difference_image,
    png_bytes,
    side_by_side,
    to_srgb8,
)
from prtbake_workers.render.metrics import compare
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.validation.chain import ValidatedView, validate_camera
from prtbake_workers.validation.scene import ValidationPart, ValidationScene

_MODULE = "prtbake_workers.jobs.validate"
READ_CHUNKS = 8
"""Chunks of the transfer file, of about 1 MiB, read at a time: 24 MiB with their float32 copy."""
MEMORY_BYTES = 12 << 30
"""What the contract allows takes 3 GiB of pictures, beside the assets and the reference's rays."""
DIFFERENCE_SCALE = 0.25
"""Exposed difference that the heat picture shows as white."""


def stages(
    inputs_of: Callable[[Results], dict[str, Any]],
    environment: LightSource,
    settings: ValidateSettings,
    seed: int,
) -> list[Stage]:
    """One task a camera; ``inputs_of`` gives digests: transfer, asset, light and maybe exact."""
    dumped = settings.model_dump(mode="json")

    def cameras(results: Results) -> list[Task]:
        return [
            Task(
                f"{_MODULE}:validate",
                {
                    **inputs_of(results),
                    "environment": environment,
                    "settings": dumped,
                    "camera": camera.model_dump(mode="json"),
                    "seed": seed + 1000 * index,
                },
                label=camera.name,
                memory_bytes=MEMORY_BYTES,
            )
            for index, camera in enumerate(settings.cameras)
        ]

    return [Stage("validate", "cameras", 15.0, cameras)]


def validate(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: hold one camera's pictures against the reference."""
    settings = ValidateSettings.model_validate(args["settings"])
    camera = Camera.model_validate(args["camera"])
    validation = load_validation(args, context.store)
    rotations = [rotation_matrix(angles) for angles in settings.rotations_deg]
    views = validate_camera(
        validation,
        camera,
        rotations,
        settings,
        seed=args["seed"],
        progress=lambda fraction: context.progress(fraction, 1.0, camera.name),
    )
    reports = []
    for index, view in enumerate(views):
        name = camera.name if len(views) == 1 else f"{camera.name}-light{index}"
        reports.append(_report(name, view, context.store))
    return {"views": reports}


def _report(name: str, view: ValidatedView, store: BlobStore) -> dict[str, Any]:
    reference, delivered = view.reference, view.delivered
    exposure = auto_exposure(reference, view.coverage.astype(np.float32))
    pictures = [to_srgb8(picture, exposure) for picture in (reference, delivered)]
    pictures.append(difference_image(delivered, reference, DIFFERENCE_SCALE / exposure))
    return {
        "picture": name,
        "hits": view.n_hits,
        "budget": view.budget.to_dict(),
        "metrics": compare(delivered, reference, view.coverage, exposure=exposure).to_dict(),
        "exposure": exposure,
        "pictures": {f"{name}.png": store.put_bytes(png_bytes(side_by_side(pictures)))},
    }


def load_validation(args: dict[str, Any], store: BlobStore) -> ValidationScene:
    """Load everything that a chain needs, from the artefacts alone."""
    check_kinship(args, store)
    with open_transfer(store.local_path(args["transfer"])) as transfer:
        header = transfer.header
    return assemble(
        args,
        store,
        header,
        delivered=read_asset(store.local_path(args["asset"])),
        exact=read_asset(store.local_path(args["exact"])) if "exact" in args else None,
    )


def assemble(
    args: dict[str, Any],
    store: BlobStore,
    header: TransferHeader,
    *,
    delivered: Asset,
    exact: Asset | None,
) -> ValidationScene:
    """Join assets with what ``args`` name: transfer, whose header it is, environment and light."""
    path = store.local_path(args["transfer"])
    scene = scene_of(header)
    bake = header.provenance["bake"]

    def relight_stored(part: int, vertices: I64, light: F64) -> F64:
        start = header.parts[part].vertex_range[0]
        return relight_vertices(path, part, vertices - start, light)

    return ValidationScene(
        scene=scene,
        accelerator=Accelerator(scene.positions, scene.traced_faces, robust=True),
        parts=tuple(
            _validation_part(
                part,
                own.view_texture,
                scene,
                occluders,
                store,
                scattered=index in header.provenance.get("scattering", ()),
            )
            for index, (part, own, occluders) in enumerate(
                zip(header.parts, delivered.parts, header.provenance["occluders"], strict=True)
            )
        ),
        basis=basis_of(header.basis),
        directions=cube_directions(bake["cube_resolution"]),
        supersample=bake["supersample"],
        relight_stored=relight_stored,
        exact=exact,
        delivered=delivered,
        environment=load_light(store, args["environment"]),
        light=read_light(store.local_path(args["light"])),
        baked_bounces=bool(header.provenance.get("interreflection")),
    )


def check_kinship(args: dict[str, Any], store: BlobStore) -> None:
    """Refuse artefacts that do not belong together: their budget would look right and be wrong."""
    for name in ("asset", "exact") if "exact" in args else ("asset",):
        source = read_asset(store.local_path(args[name])).provenance.get("transfer")
        if source != args["transfer"]:
            raise InputError(
                f"the asset was compressed from another transfer ({source})", pointer=f"/{name}"
            )
    fitted = read_light(store.local_path(args["light"])).provenance.get("environment")
    if fitted != args["environment"]:
        raise InputError(
            f"the light was fitted to another environment ({fitted})", pointer="/light"
        )


def relight_vertices(path: Path, part: int, vertices: I64, light: F64) -> F64:
    """Contract stored coefficients of some vertices of a part, in rising order, with light.

    Columns of light are triples of colours, and transfer of three channels lights each colour by
    its own.  Coefficients are read a few chunks of the file at a time; chunks without a vertex are
    not read.
    """
    with open_transfer(path) as transfer:
        own = transfer.header.parts[part]
        n_channels = own.n_channels
        result = np.zeros((len(vertices), own.n_terms, light.shape[1]))
        step = READ_CHUNKS * transfer_chunk_vertices(n_channels * own.n_terms, len(light))
        gaps = np.flatnonzero(np.diff(vertices // step)) + 1
        for run in np.split(np.arange(len(vertices)), gaps):
            if run.size == 0:
                continue
            chosen = vertices[run]
            block = transfer.read(part, int(chosen[0]), int(chosen[-1]) + 1)
            for row, at in zip(run, chosen - chosen[0], strict=True):
                result[row] = light_rows(block[at].astype(np.float64), light, n_channels)
    return result


def light_rows(rows: F64, light: F64, n_channels: int) -> F64:
    """Light the coefficients of one vertex.

    Parameters
    ----------
    rows
        (channels x terms, coeffs), channel by channel.
    light
        (coeffs, columns) whitened light; column j has colour j mod 3.
    n_channels
        1, which lights all colours, or 3.

    Returns
    -------
    ndarray
        (terms, columns).
    """
    if n_channels == 1:
        return np.asarray(rows @ light)
    terms = rows.reshape(n_channels, -1, rows.shape[1])
    result = np.empty((terms.shape[1], light.shape[1]))
    for channel, own in enumerate(terms):
        result[:, channel::n_channels] = own @ light[:, channel::n_channels]
    return result


def scene_of(header: TransferHeader) -> Scene:
    """Rebuild the scene that was baked."""
    ranges = tuple(part.vertex_range for part in header.parts)
    frames = tangent_frames(header.normals)
    for part in header.parts:
        if part.frames is not None:
            frames[slice(*part.vertex_range)] = part.frames
    starts = np.array([start for start, _ in ranges])
    owner = np.searchsorted(starts, header.faces[:, 0], side="right") - 1
    return Scene(
        positions=header.positions,
        faces=header.faces,
        normals=header.normals,
        frames=frames,
        areas=vertex_areas(header.positions, header.faces),
        uv=header.uv,
        part_ranges=ranges,
        part_of_face=owner.astype(np.int32),
        bodies=bodies_of([part.role for part in header.parts]),
        two_sided=tuple(part.two_sided for part in header.parts),
    )


def _validation_part(
    part: TransferPart,
    delivered: F32 | None,
    scene: Scene,
    occluders: list[int],
    store: BlobStore,
    *,
    scattered: bool,
) -> ValidationPart:
    """Rebuild a part; its view texture of all terms gets the resolution that was delivered."""
    brdf = load_brdf(store, dict(part.material))
    factorisation = factorisation_from_tables(part.factorisation or {}, brdf=brdf)
    texture = None if delivered is None else view_texture(factorisation, len(delivered))
    return ValidationPart(
        brdf=brdf,
        factorisation=factorisation,
        view_texture=texture,
        occluders=occluder_accelerator(scene, occluders),
        medium=None if part.subsurface is None else make_dipole(part.subsurface),
        scattered=scattered,
    )
