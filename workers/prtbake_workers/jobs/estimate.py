"""Quick job ``estimate``: validate and plan a request without running it."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.jobs import (
    AssetRequest,
    BakeRequest,
    CalibrateRequest,
    CompressRequest,
    Estimate,
    FitLightRequest,
    RenderRequest,
    StudyRequest,
    ValidateRequest,
    job_request_adapter,
)
from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import (
    BakeSettings,
    CompressSettings,
    RenderSettings,
    ValidateSettings,
)
from prtbake_storage.decode.transfer_basis import SphericalHarmonics, TransferBasis
from prtbake_storage.hdf5.light import read_light
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import TransferHeader, TransferPart, open_transfer
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Finished, Results, Stage, Task
from prtbake_workers.brdf.oriented_factorisation import OrientedFactorisation
from prtbake_workers.brdf.stored_factorisation import factorisation_from_tables
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.jobs import calibrate, study_estimate
from prtbake_workers.jobs.bake_budget import BakeSearch
from prtbake_workers.jobs.compress import compressions_of, work_of
from prtbake_workers.jobs.lights import check_light, light_source
from prtbake_workers.jobs.plan import arguments, plan_scene
from prtbake_workers.jobs.validate import check_kinship, scene_of
from prtbake_workers.jobs.work import (
    Work,
    asset_memory,
    asset_work,
    fit_samples,
    n_texels,
    rates_of,
    wall_seconds,
)
from prtbake_workers.percent import percent
from prtbake_workers.planning.cost import compress_memory_bytes, factor_floats
from prtbake_workers.planning.expected_sizes import expected_cost, expected_sizes
from prtbake_workers.planning.file_bytes import (
    PartNumbers,
    asked_asset_bytes,
    asset_bytes,
    known_bytes,
    light_bytes,
)
from prtbake_workers.planning.ladder_steps import legal_steps
from prtbake_workers.planning.later_stages import REPORT_WORK
from prtbake_workers.planning.picture_bytes import (
    preview_files,
    validation_files,
    with_reports,
)
from prtbake_workers.planning.planned import Plan
from prtbake_workers.planning.presets import (
    PartCompression,
    PlannedBake,
    StageSettings,
    below_quality,
    resolve_stages,
)
from prtbake_workers.planning.seen_pixels import look
from prtbake_workers.planning.stage_memory import (
    Lobe,
    fit_memory_bytes,
    render_memory_bytes,
    validate_memory_bytes,
)
from prtbake_workers.planning.stage_work import fit_work, render_work, validate_work
from prtbake_workers.planning.uncounted import uncounted

_MODULE = "prtbake_workers.jobs.estimate"
MEMORY_BYTES = 6 << 30
CPU_SECONDS = 300
OneRequest = (
    BakeRequest
    | CompressRequest
    | FitLightRequest
    | RenderRequest
    | ValidateRequest
    | AssetRequest
    | CalibrateRequest
)
BAKE_STAGES = ("plan", "bake", "scattering", "bounces", "add_bounces", "join", "report")
BAKE_FILES = ("transfer.h5",)
"""What a lone bake runs and leaves, of the plan of a whole asset."""


def stages(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    """Plan in one limited task."""
    # when it began changes no estimate: the same question finds the same answer
    given = {name: value for name, value in context.items() if name != "started"}
    args = {"request": request["request"], "context": given}

    def plan(_: Results) -> list[Task]:
        return [
            Task(
                f"{_MODULE}:estimate",
                args,
                label="estimate",
                memory_bytes=MEMORY_BYTES,
                cpu_seconds=CPU_SECONDS,
            )
        ]

    return [Stage("estimate", "plan", 1.0, plan)]


def finish(results: Results) -> Finished:
    """Give the estimate."""
    return Finished(result=results["estimate"][0])


def estimate(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: check what the request refers to, and predict what the job would cost."""
    request = job_request_adapter.validate_python(args["request"])
    if isinstance(request, StudyRequest):
        return study_estimate.predict(request, args["context"], context.store, predict)
    return predict(request, args["request"], args["context"], context.store).model_dump(mode="json")


def predict(
    request: OneRequest, body: dict[str, Any], given: dict[str, Any], store: BlobStore
) -> Estimate:
    """Predict a job of any kind but a study."""
    match request:
        case AssetRequest() | BakeRequest():
            return _scene(request, body, given, store)
        case CompressRequest():
            return _compress(request, given, store)
        case FitLightRequest():
            check_light(store, light_source(given))
            return _fit_light(below_quality("fit_light", request.settings, request.quality), given)
        case RenderRequest():
            return _render(request.settings, given, store)
        case ValidateRequest():
            return _validate(request.settings, given, store)
        case CalibrateRequest():
            return Estimate(
                plan={"kind": "calibrate"},
                seconds={"calibrate": calibrate.SECONDS},
                total_seconds=calibrate.SECONDS,
                artefact_bytes={},
                peak_memory_bytes=None,
                errors={},
            )


def _scene(
    request: AssetRequest | BakeRequest,
    body: dict[str, Any],
    given: dict[str, Any],
    store: BlobStore,
) -> Estimate:
    """Plan the scene: also gives the errors that are known before the first ray."""
    settings, quality = _settings(request)
    foretold: dict[str, float] = {}
    tried: tuple[str, ...] = ()
    if isinstance(request, BakeRequest) and request.budget is not None:
        settings, foretold, tried = _first_bake(body, given, store)
    args = arguments(body, given, settings, quality)
    if isinstance(request, AssetRequest) and request.budget is not None and request.budget.searched:
        steps = legal_steps(request.settings)[1:]
        args["steps"] = {name: own.to_dict() for name, own in steps}
    planned, plan = plan_scene(args, store)
    alone = isinstance(request, BakeRequest)
    resolved = replace(settings, bake=BakeSettings.model_validate(planned.header["bake"]))
    work = asset_work(plan.to_dict(), resolved, given)
    if alone:
        work = {name: own for name, own in work.items() if name in BAKE_STAGES}
    files = BAKE_FILES if alone else tuple(plan.artefact_bytes)
    seconds, lasting = _durations(work, given)
    return Estimate(
        plan=plan.to_dict(),
        seconds=seconds,
        total_seconds=lasting,
        artefact_bytes=_at_most(request, {name: plan.artefact_bytes[name] for name in files}),
        artefact_bytes_at_most=with_reports(
            {} if alone else preview_files(resolved.render) | validation_files(resolved.validation),
            n_parts=len(plan.parts),
        ),
        peak_memory_bytes=max(
            count
            for stage, count in asset_memory(plan.to_dict(), resolved, given).items()
            if stage in work
        ),
        errors={
            f"K terms ({part['name']})": factorisation.energy_lost
            for part, factorisation in zip(
                planned.header["parts"], planned.factorisations, strict=True
            )
        }
        | foretold,
        warnings=[
            *tried,
            *plan.notes,
            *(() if alone else uncounted(resolved.compress, resolved.fit_light).values()),
            *_budget_warnings(request, plan, lasting),
        ],
    )


def _at_most(request: AssetRequest | BakeRequest, predicted: dict[str, int]) -> dict[str, int]:
    """Hold the predicted bytes of the asset against those that it may have."""
    if not isinstance(request, AssetRequest) or request.budget is None:
        return predicted
    most = request.budget.max_bytes
    return predicted if most is None else predicted | {"asset.h5": min(predicted["asset.h5"], most)}


def _first_bake(
    body: dict[str, Any], given: dict[str, Any], store: BlobStore
) -> tuple[StageSettings, dict[str, float], tuple[str, ...]]:
    """Try the scene of a bake with a budget: settings of its first bake, what that is to leave.

    Raises
    ------
    SettingsError
        The job would be refused before it baked.
    """
    first = BakeSearch(body, given).first(store)
    errors = {
        f"directions and functions ({name})": float(error)
        for name, error in zip(first.names, first.projection, strict=True)
    }
    return (
        first.settings,
        errors,
        (
            f"the first bake for the budget, whose seconds, bytes and memory these are, is "
            f"predicted to leave {percent(first.error)} (relative L2) in {first.size} bytes; "
            "others may follow, as it measures itself",
        ),
    )


def _budget_warnings(
    request: AssetRequest | BakeRequest, plan: Plan, lasting: float
) -> tuple[str, ...]:
    """Say what of a search is predicted, and whether its time can be kept at all."""
    if not isinstance(request, AssetRequest) or request.budget is None:
        return ()
    if not request.budget.searched:
        return ()
    steps = ", ".join(f"{step.quality} {step.seconds:.0f} s" for step in plan.ladder)
    found = [
        "the budget is searched from quality draft on, whose seconds, bytes and memory these are"
        + (f"; making an asset of other qualities is predicted to take {steps}" if steps else "")
    ]
    seconds = request.budget.max_seconds
    if seconds is not None and lasting > seconds:
        found.append(
            f"budget.max_seconds: {seconds:g} s are too few, the least is predicted to be "
            f"{lasting:.0f} s; the job would be refused"
        )
    return tuple(found)


def _compress(request: CompressRequest, given: dict[str, Any], store: BlobStore) -> Estimate:
    """Predict from the header of the transfer."""
    settings = below_quality("compress", request.settings, request.quality)
    with open_transfer(store.local_path(given["artefacts"]["transfer"]["digest"])) as transfer:
        header = transfer.header
    compressions = compressions_of(header, settings, request.quality or "medium")
    costs = [
        expected_cost(
            _bake_of(header.basis),
            compression,
            settings.max_error,
            n_verts=part.n_vertices,
            n_terms=part.n_terms,
            n_channels=part.n_channels,
        )
        for part, compression in zip(header.parts, compressions, strict=True)
    ]
    work = work_of(header, settings, compressions) | {"report": REPORT_WORK}
    seconds, lasting = _durations(work, given)
    return Estimate(
        plan={
            "kind": "compress",
            "parts": [
                {"name": part.name, "compression": asdict(compression)}
                for part, compression in zip(header.parts, compressions, strict=True)
            ],
            "work": work,
        },
        seconds=seconds,
        total_seconds=lasting,
        artefact_bytes=_asset_files(header, compressions, settings),
        artefact_bytes_at_most=with_reports({}, n_parts=len(header.parts)),
        peak_memory_bytes=compress_memory_bytes(costs),
        errors={},
        warnings=list(uncounted(settings).values()),
    )


def _asset_files(
    header: TransferHeader, compressions: Sequence[PartCompression], settings: CompressSettings
) -> dict[str, int]:
    """Predict the files that compressing a transfer leaves."""
    factorisations = [factorisation_from_tables(own.factorisation or {}) for own in header.parts]
    known = known_bytes(
        [header.positions, header.normals] + ([] if header.uv is None else [header.uv]),
        header.faces,
        [
            [one for one in (own.albedo_texture, own.vertex_colours) if one is not None]
            for own in header.parts
        ],
        factorisations,
        [np.eye(3)[None] if own.frames is None else own.frames for own in header.parts],
        n_centres=_bake_of(header.basis).n_centres or 0,
    )
    numbers = []
    scattering = header.provenance.get("scattering", ())
    for index, (part, compression, brdf) in enumerate(
        zip(header.parts, compressions, factorisations, strict=True)
    ):
        size = {
            "n_verts": part.n_vertices,
            "n_terms": part.n_terms,
            "n_coeffs": header.basis.n_coeffs,
            "n_channels": part.n_channels,
        }
        numbers.append(
            PartNumbers(
                n_verts=part.n_vertices,
                n_rows=part.n_rows,
                n_channels=part.n_channels,
                even=part.role == "receiver",
                n_coeffs=header.basis.n_coeffs,
                factor_floats=factor_floats(
                    expected_sizes(compression, settings.max_error, **size), **size
                ),
                view_columns=compression.ranks[0] * brdf.n_channels,
                scattered=index in scattering,
            )
        )
    return {
        "asset.h5": asked_asset_bytes(known, numbers, settings),
        "asset-float32.h5": asset_bytes(known, numbers, bits=32),
    }


def _bake_of(basis: TransferBasis) -> PlannedBake:
    """Give settings whose basis has as many functions."""
    if isinstance(basis, SphericalHarmonics):
        return PlannedBake(basis="sh", sh_order=basis.order)
    return PlannedBake.model_validate({"n_centres": basis.n_coeffs})


def _validate(settings: ValidateSettings, given: dict[str, Any], store: BlobStore) -> Estimate:
    """Check that the artefacts belong together, and predict from the header of the transfer."""
    digests = {name: artefact["digest"] for name, artefact in given["artefacts"].items()}
    check_kinship(digests | {"environment": light_source(given)}, store)
    with open_transfer(store.local_path(digests["transfer"])) as transfer:
        header = transfer.header
    scene, bake = scene_of(header), PlannedBake.model_validate(header.provenance["bake"])
    media = [index for index, part in enumerate(header.parts) if part.subsurface is not None]
    seen = look(
        scene,
        Accelerator(scene.positions, scene.traced_faces),
        settings.cameras,
        width=settings.width,
        height=settings.height,
        object_ranges=[part.vertex_range for part in header.parts if part.role == "object"],
        media=media,
    )
    lit: dict[str, Any] = {
        "seen": seen,
        "n_texels": n_texels(given),
        "baked_bounces": bool(header.provenance.get("interreflection")),
    }
    terms = [part.n_terms for part in header.parts]
    return _only(
        "validate",
        {"validate": validate_work(settings, bake, n_terms=max(terms), **lit)},
        given,
        memory_bytes=validate_memory_bytes(
            settings,
            bake=bake,
            part_terms=terms,
            lobes=[_lobe_of(part) for part in header.parts],
            **lit,
        ),
        at_most=validation_files(settings),
        n_parts=len(terms),
    )


def _lobe_of(part: TransferPart) -> Lobe:
    """Say what a stored part has beside its diffuse reflection."""
    if part.material["model"] == "lambert":
        return "none"
    tables = factorisation_from_tables(part.factorisation or {})
    return "anisotropic" if isinstance(tables, OrientedFactorisation) else "isotropic"


def _fit_light(settings: FitLightSettings, given: dict[str, Any]) -> Estimate:
    """Predict from what the registration counted of the map."""
    texels, samples = n_texels(given), fit_samples(settings, given)
    return _only(
        "fit_light",
        {"fit_light": fit_work(settings, n_texels=texels, samples=samples)},
        given,
        memory_bytes=fit_memory_bytes(settings, n_texels=texels, samples=samples),
        files={"light.h5": light_bytes(settings)},
        warnings=list(uncounted(CompressSettings(), settings).values()),
    )


def _render(settings: RenderSettings, given: dict[str, Any], store: BlobStore) -> Estimate:
    """Predict from the asset, and see that the light can be read."""
    asset = read_asset(store.local_path(given["artefacts"]["asset"]["digest"]))
    read_light(store.local_path(given["artefacts"]["light"]["digest"]))
    values = sum(part.n_vertices * part.n_channels * len(part.view_basis) for part in asset.parts)
    work = render_work(settings, n_verts=len(asset.positions), n_values=values)
    return _only(
        "render",
        {"render": work},
        given,
        memory_bytes=render_memory_bytes(settings),
        at_most=preview_files(settings),
        n_parts=len(asset.parts),
    )


def _only(
    kind: str,
    work: Work,
    given: dict[str, Any],
    *,
    memory_bytes: int,
    files: dict[str, int] | None = None,
    at_most: dict[str, int] | None = None,
    n_parts: int = 0,
    warnings: Sequence[str] = (),
) -> Estimate:
    """Predict a job of one stage and its report."""
    seconds, lasting = _durations(work | {"report": REPORT_WORK}, given)
    return Estimate(
        plan={"kind": kind, "work": work},
        seconds=seconds,
        total_seconds=lasting,
        artefact_bytes=files or {},
        artefact_bytes_at_most=with_reports(at_most or {}, n_parts=n_parts),
        peak_memory_bytes=memory_bytes,
        errors={},
        warnings=list(warnings),
    )


def _durations(
    work: Mapping[str, Mapping[str, float]], given: dict[str, Any]
) -> tuple[dict[str, float], float]:
    """Predict the seconds of every stage, and how long the job lasts."""
    return rates_of(given).all_seconds(work), wall_seconds(work, given, work)


def _settings(request: AssetRequest | BakeRequest) -> tuple[StageSettings, Any]:
    if isinstance(request, AssetRequest):
        quality = request.planned_quality
        return resolve_stages(quality, request.planned_settings), quality
    return StageSettings.for_bake(request.settings, request.quality), request.quality or "medium"
