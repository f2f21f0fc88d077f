"""Task ``plan`` of a bake: inputs loaded, materials factorised, effects decided, tiles cut."""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.asset_budget import AssetBudget
from prtbake_storage.contract.settings import (
    AssetSettings,
    BakeSettings,
    CompressSettings,
    Effects,
    Quality,
)
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.schema import transfer_chunk_vertices
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Task
from prtbake_workers.brdf.base import Brdf, is_isotropic
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.harmonic_factorisation import HarmonicFactorisation
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.scene import Scene, bodies_of
from prtbake_workers.jobs.inputs import load_brdf, load_mesh, versions
from prtbake_workers.jobs.materials import PartInput, part_inputs
from prtbake_workers.jobs.media import make_dipole
from prtbake_workers.jobs.part_factorisations import factorise_all
from prtbake_workers.jobs.plan_notes import repairs, side_notes, term_notes, unread_tangents
from prtbake_workers.jobs.rounding import SHARE
from prtbake_workers.jobs.scene_file import (
    PlannedScene,
    StoredProjection,
    make_basis,
    occluder_accelerator,
    reflection_of,
    write_projection,
    write_scene,
)
from prtbake_workers.planning.cluster_limit import cluster_note
from prtbake_workers.planning.effects import decide_effects
from prtbake_workers.planning.file_bytes import known_bytes, least_bytes
from prtbake_workers.planning.grain import Grain, grain_notes
from prtbake_workers.planning.ladder_steps import StepCost, ladder_steps, neighbours
from prtbake_workers.planning.light_resolution import choose_light_resolution
from prtbake_workers.planning.plan import check_bandwidth, make_plan, occluders_of
from prtbake_workers.planning.planned import Plan
from prtbake_workers.planning.presets import StageSettings
from prtbake_workers.planning.registers import check_planned_registers
from prtbake_workers.planning.resolution import resolution_of
from prtbake_workers.planning.seen_pixels import look
from prtbake_workers.planning.stage_memory import Lobe
from prtbake_workers.planning.stage_work import total
from prtbake_workers.planning.step_errors import energy_left
from prtbake_workers.planning.subsurface import decide_subsurface
from prtbake_workers.planning.trial_compression import MOST_FUNCTIONS, Trials, try_parts
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.mirrored import product_of
from prtbake_workers.transport.surface import OpaqueSurface

_MODULE = "prtbake_workers.jobs.plan"
MEMORY_BYTES = 12 << 30
CPU_SECONDS = 900
INPUTS = (
    "mesh",
    "brdf",
    "albedo_texture",
    "subsurface",
    "vertex_colours",
    "tangents",
    "two_sided",
    "materials",
    "receiver",
)
"""Arguments that say what a scene is made of."""


def arguments(
    request: dict[str, Any], context: dict[str, Any], settings: StageSettings, quality: Quality
) -> dict[str, Any]:
    """Collect all that the plan of a request depends on."""
    specs = context.get("materials", {})
    return {
        "mesh": context["mesh"]["canonical"],
        "brdf": context["brdf"]["spec"],
        "albedo_texture": context.get("albedo_texture"),
        "subsurface": request.get("subsurface"),
        "vertex_colours": request.get("vertex_colours", False),
        "tangents": request.get("tangents", "horizontal"),
        "two_sided": request.get("two_sided", False),
        "materials": {
            name: material | {"brdf": specs[name]["spec"]}
            for name, material in request.get("materials", {}).items()
        },
        "receiver": request.get("receiver"),
        "asset": "environment" in request,
        "effects": request.get("effects", {}),
        "settings": settings.to_dict(),
        "quality": quality,
        "steps": _steps(request, quality),
        "budget_bytes": _budget_bytes(request),
        "seed": request.get("seed", 0),
    }


def _budget_bytes(request: dict[str, Any]) -> int | None:
    """Give the bytes that a budget leaves an asset; a lone bake has none."""
    budget = request.get("budget") if "environment" in request else None
    return None if budget is None else budget.get("max_bytes")


def _steps(request: dict[str, Any], quality: Quality) -> dict[str, Any]:
    """Give the settings of the qualities beside that of an asset, or of an attempt of a budget."""
    if "environment" not in request:
        return {}  # a lone bake, whose settings are of no stages
    own = quality if request.get("budget") is not None else request.get("quality")
    if own is None:
        return {}
    overrides = AssetSettings.model_validate(request.get("settings", {}))
    if request.get("budget") is not None:
        overrides = AssetBudget.model_validate(request["budget"]).laid_over(overrides)
    return {quality: settings.to_dict() for quality, settings in neighbours(own, overrides).items()}


def task(args: dict[str, Any]) -> Task:
    """Make the task; its limits are for the albedo texture, which came from outside."""
    return Task(
        f"{_MODULE}:plan",
        args,
        label="plan",
        memory_bytes=MEMORY_BYTES,
        cpu_seconds=CPU_SECONDS,
    )


def plan_scene(args: dict[str, Any], store: BlobStore) -> tuple[PlannedScene, Plan]:
    """Load the inputs, factorise the materials, decide effects, parts and tiles."""
    try:
        return _plan_scene(args, store)
    except SettingsError as error:
        # the settings of a lone bake are of no stages
        if not args["asset"] and error.pointer is not None:
            error.pointer = error.pointer.replace("/settings/bake/", "/settings/", 1)
        raise


def _plan_scene(args: dict[str, Any], store: BlobStore) -> tuple[PlannedScene, Plan]:
    settings = StageSettings.from_dict(args["settings"])
    check_bandwidth(settings.bake)
    mesh, report = load_mesh(store, args["mesh"])
    parts = part_inputs(args, mesh, store)
    names, roles = [part.name for part in parts], [part.role for part in parts]
    textures = tuple(part.albedo_texture for part in parts)
    colours = tuple(part.vertex_colours for part in parts)
    brdfs = [load_brdf(store, part.brdf) for part in parts]
    grain = _grain_of(parts, brdfs)
    scene = Scene.from_parts(
        [part.mesh for part in parts],
        frame_seed=settings.bake.frame_seed,
        frames=[None if own is None else own.frames for own in grain],
        bodies=bodies_of(roles),
        two_sided=tuple(part.two_sided for part in parts),
    )
    arrays = [scene.positions, scene.normals]
    arrays += [] if scene.uv is None else [np.nan_to_num(scene.uv)]
    _check_bytes(args["budget_bytes"], settings.compress, least_bytes(arrays, scene.faces))
    requested = Effects.model_validate(args["effects"])
    specs = [json.dumps(part.brdf, sort_keys=True) for part in parts]
    view_dependent = requested.view_dependence != "off"
    factorisations = factorise_all(specs, brdfs, settings.bake, view_dependent=view_dependent)
    part_terms = [factorisation.n_terms for factorisation in factorisations]
    accelerator = Accelerator(scene.positions, scene.traced_faces)
    media = [None if part.subsurface is None else make_dipole(part.subsurface) for part in parts]
    scattering = decide_subsurface(
        OpaqueSurface(scene, accelerator),
        media,
        settings.bake,
        requested.subsurface_scattering,
        seed=args["seed"] + 5,
    )
    # what a medium gives back of even light, where it falls: all of a part that does not scatter
    within = tuple(
        own if medium is None else own.tinted(medium.diffuse_albedo)
        for own, medium in zip(factorisations, media, strict=True)
    )
    effects = decide_effects(
        mesh,
        scene,
        accelerator,
        names=names,
        roles=roles,
        factorisations=within,
        albedo=reflection_of(scene, within, textures, colours)[1],
        bake=settings.bake,
        watertight=bool(report.get("watertight", False)),
        requested=requested,
        seed=args["seed"],
        subsurface=scattering.decision,
        grain=grain,
    )
    factorisations = tuple(
        (factorisations if part in scattering.parts else within)[part] for part in range(len(parts))
    )
    notes: tuple[str, ...] = ()
    probe_bytes, probe_work = 0, {}
    if settings.bake.open_numbers:
        chosen = choose_light_resolution(
            scene,
            _accelerators(scene, [occluders_of(p, roles, effects) for p in range(len(parts))]),
            factorisations,
            settings.bake,
            names=names,
            seed=args["seed"] + 6,
        )
        settings, notes = replace(settings, bake=chosen.bake), chosen.notes
        probe_bytes, probe_work = chosen.memory_bytes, chosen.work
        effects.append(chosen.decision)
    spectra = [factorisation.singular_values for factorisation in factorisations]
    lay_out = partial(
        make_plan,
        scene,
        names,
        effects=effects,
        roles=roles,
        chunk_vertices=transfer_chunk_vertices,
        spectra=spectra,
        notes=[
            *notes,
            *term_notes(names, factorisations),
            *grain_notes(grain, unread_tangents(parts, grain)),
            *side_notes(parts, bool(report.get("watertight", False))),
            *filter(
                None,
                (
                    cluster_note(names[part], limit, settings.bake.subsurface_tolerance)
                    for part, limit in zip(scattering.parts, scattering.limits, strict=True)
                ),
            ),
            *repairs(report),
            *report.get("warnings", []),
        ],
        media={part: own for part, own in enumerate(media) if own is not None},
        scattering=dict(zip(scattering.parts, scattering.limits, strict=True)),
        n_oriented=sum(own is not None for own in grain),
        probe_bytes=probe_bytes,
        probe_work=probe_work,
        known=known_bytes(
            arrays,
            scene.faces,
            [
                [one for one in (texture, own) if one is not None]
                for texture, own in zip(textures, colours, strict=True)
            ],
            factorisations,
            [scene.frames[start:stop] for start, stop in scene.part_ranges],
            n_centres=settings.planned_bake.n_centres or 0,
        ),
        view_channels=[own.n_channels for own in factorisations],
        lobes=[_lobe_of(brdf, own) for brdf, own in zip(brdfs, grain, strict=True)],
        seen=look(
            scene,
            accelerator,
            settings.validation.cameras,
            width=settings.validation.width,
            height=settings.validation.height,
            object_ranges=_object_ranges(scene, roles),
            media=[part for part, own in enumerate(media) if own is not None],
        ),
    )

    own = lay_out(part_terms=part_terms, settings=settings, quality=args["quality"])
    trials = None
    if args["asset"]:
        trials = _trials(own, scene, factorisations, settings, seed=args["seed"] + 7)
    if trials is not None:
        lay_out = partial(
            lay_out,
            tried=trials.number_bytes,
            probe_bytes=max(probe_bytes, trials.memory_bytes),
            probe_work=total([probe_work, trials.work]),
        )
        own = lay_out(part_terms=part_terms, settings=settings, quality=args["quality"])
    resolution = resolution_of(own, settings, energy_left(spectra, part_terms))

    def cost_of(terms: list[int], settings: StageSettings, quality: Quality) -> StepCost:
        # what was tried is of this quality's terms, ranks and error
        other = lay_out(part_terms=terms, settings=settings, quality=quality, tried=())
        return StepCost(
            other.seconds,
            other.artefact_bytes["asset.h5"],
            resolution_of(other, settings, energy_left(spectra, terms)),
        )

    steps = ladder_steps(
        {quality: StageSettings.from_dict(step) for quality, step in args["steps"].items()},
        part_terms,
        spectra,
        cost_of,
        own=resolution,
        view_dependent=view_dependent,
    )
    plan = replace(own, ladder=steps, resolution=resolution)
    for part in plan.parts:
        start, stop = part.vertex_range
        check_planned_registers(
            settings.compress,
            part.name,
            part.compression,
            n_verts=stop - start,
            n_terms=part.n_terms,
        )
    header = _header(args, settings.bake, parts, plan, scattering.parts)
    return PlannedScene(scene, factorisations, textures, colours, header), plan


def _trials(
    plan: Plan,
    scene: Scene,
    factorisations: Sequence[Factorisation],
    settings: StageSettings,
    *,
    seed: int,
) -> Trials | None:
    """Try the compression of every part, where the error that it leaves chooses the bits."""
    asked, bake = settings.compress, settings.planned_bake
    searched = (asked.max_error, asked.max_bytes) != (None, None)
    if asked.bits != "auto" or searched or bake.n_coeffs > MOST_FUNCTIONS:
        return None
    return try_parts(
        scene,
        _accelerators(scene, [part.occluders for part in plan.parts]),
        factorisations,
        plan,
        make_basis(bake.model_dump(mode="json")),
        cube_resolution=bake.cube_resolution,
        share=SHARE,
        max_error=asked.max_quantisation_error,
        seed=seed,
    )


def _check_bytes(budget: int | None, compress: CompressSettings, least: int) -> None:
    """Refuse bytes that the mesh alone exceeds, before anything is baked."""
    asked, pointer = budget, "/budget/max_bytes"
    if asked is None:
        asked, pointer = compress.max_bytes, "/settings/compress/max_bytes"
    if asked is not None and asked < least:
        raise SettingsError(
            f"max_bytes is {asked}: the mesh alone takes more than {least}, and tables and labels "
            "come to it",
            pointer=pointer,
        )


def _header(
    args: dict[str, Any],
    bake: BakeSettings,
    parts: Sequence[PartInput],
    plan: Plan,
    scattering: Sequence[int],
) -> dict[str, Any]:
    """Give what the planned scene says of itself: see `PlannedScene`."""
    bounces = None
    if plan.bounces is not None:
        bounces = {name: value for name, value in asdict(plan.bounces).items() if name != "blocks"}
    dumped = bake.model_dump(mode="json")
    return {
        "bake": dumped,
        "bounces": bounces,
        "parts": [
            {
                "name": part.name,
                "role": part.role,
                "two_sided": part.two_sided,
                "material": part.brdf,
                "subsurface": part.subsurface,
                "occluders": list(planned.occluders),
            }
            for part, planned in zip(parts, plan.parts, strict=True)
        ],
        "provenance": {
            "inputs": {name: args[name] for name in INPUTS},
            "bake": dumped,
            "quality": args["quality"],
            "tiles": [[list(tile) for tile in part.tiles] for part in plan.parts],
            "seed": args["seed"],
            "versions": versions(),
            "effects": [decision.to_dict() for decision in plan.effects],
            "interreflection": bounces if bounces and bounces["max_bounces"] else None,
            "scattering": list(scattering),
            "occluders": [list(part.occluders) for part in plan.parts],
        },
    }


def _lobe_of(brdf: Brdf, grain: Grain | None) -> Lobe:
    if isinstance(brdf, Lambert):
        return "none"
    return "isotropic" if grain is None else "anisotropic"


def _object_ranges(scene: Scene, roles: Sequence[str]) -> list[tuple[int, int]]:
    """Give the vertices that cameras frame."""
    return [own for own, role in zip(scene.part_ranges, roles, strict=True) if role == "object"]


def _accelerators(scene: Scene, occluders: Sequence[tuple[int, ...]]) -> list[Accelerator | None]:
    """Make what blocks the light of each part; parts that the same blocks share it."""
    made = {parts: occluder_accelerator(scene, list(parts)) for parts in set(occluders)}
    return [made[parts] for parts in occluders]


def _grain_of(parts: Sequence[PartInput], brdfs: Sequence[Brdf]) -> list[Grain | None]:
    """Lay tangents over the parts whose BRDF depends on them."""
    return [
        None if is_isotropic(brdf) else Grain.of(part.name, part.mesh, part.tangents)
        for part, brdf in zip(parts, brdfs, strict=True)
    ]


def plan(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: write the planned scene."""
    planned, plan = plan_scene(args, context.store)
    # a basis that cannot be solved fails here, before the first ray
    basis = planned.basis()
    directions = cube_directions(planned.header["bake"]["cube_resolution"])
    projection = basis.projection(directions.directions, directions.weights)
    product = product_of(projection, directions.directions)
    projected = write_projection(
        context.scratch / "projection.h5",
        StoredProjection(projection, product, basis.functions),
    )
    path = write_scene(context.scratch / "scene.h5", planned)
    return {
        "scene": context.store.put_file(path, move=True),
        "projection": context.store.put_file(projected, move=True),
        "plan": plan.to_dict(),
        "errors": {
            part["name"]: factorisation.energy_lost
            for part, factorisation in zip(
                planned.header["parts"], planned.factorisations, strict=True
            )
        },
        "black": [own.is_black for own in planned.factorisations],
        "condition": basis.condition,
        "transfer": {
            "basis": basis.stored.kind,
            "coefficients": basis.n,
            # what is baked: one term of either kind is that of svd
            "factorisation": "sh"
            if any(isinstance(own, HarmonicFactorisation) for own in planned.factorisations)
            else "svd",
        },
        "settings": args["settings"] | {"bake": planned.header["bake"]},
    }
