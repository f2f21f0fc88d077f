"""Job kind ``bake``: plan, transport tiles, join."""

from dataclasses import asdict
from typing import Any

import numpy as np

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.brdf import LambertSpec
from prtbake_storage.contract.settings import Effects, Quality, ReceiverPlane
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.schema import transfer_chunk_vertices
from prtbake_storage.hdf5.transfer import (
    TransferHeader,
    TransferPart,
    join_transfer,
    write_transfer_tile,
)
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.ray_offset import ray_epsilon, self_hit_count
from prtbake_workers.geometry.receiver import receiver_plane
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.jobs import bounce
from prtbake_workers.jobs.inputs import load_brdf, load_mesh, load_texture, versions
from prtbake_workers.jobs.scene_file import (
    PlannedScene,
    centres_and_bandwidth,
    read_projection,
    read_scene,
    reflection_of,
    write_projection,
    write_scene,
)
from prtbake_workers.planning.effects import decide_effects
from prtbake_workers.planning.plan import Plan, check_bandwidth, make_plan
from prtbake_workers.planning.presets import StageSettings
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.held_out import held_out_energies
from prtbake_workers.transport.quantise import quantise_transfer

_MODULE = "prtbake_workers.jobs.bake"
PLAN_MEMORY_BYTES = 12 << 30
PLAN_CPU_SECONDS = 900


def stages(
    request: dict[str, Any], context: dict[str, Any], settings: StageSettings, quality: Quality
) -> list[Stage]:
    """Plan the scene, bake its tiles, bounce their light, join them."""
    threads = settings.bake.threads
    plan_args = {
        "mesh": context["mesh"]["canonical"],
        "brdf": context["brdf"]["spec"],
        "albedo_texture": context.get("albedo_texture"),
        "receiver": request.get("receiver"),
        "effects": request.get("effects", {}),
        "settings": settings.to_dict(),
        "quality": quality,
        "seed": request.get("seed", 0),
    }

    def plan(_: Results) -> list[Task]:
        return [
            Task(
                f"{_MODULE}:plan",
                plan_args,
                label="plan",
                # it decodes the albedo texture, which came from outside
                memory_bytes=PLAN_MEMORY_BYTES,
                cpu_seconds=PLAN_CPU_SECONDS,
            )
        ]

    def tiles(results: Results) -> list[Task]:
        (planned,) = results["plan"]
        return [
            Task(
                f"{_MODULE}:run_tile",
                {
                    "scene": planned["scene"],
                    "projection": planned["projection"],
                    "part": index,
                    "start": start,
                    "stop": stop,
                },
                label=f"{part['name']} {start}-{stop}",
                threads=threads,
            )
            for index, part in enumerate(planned["plan"]["parts"])
            for start, stop in part["tiles"]
        ]

    def join(results: Results) -> list[Task]:
        (planned,) = results["plan"]
        last = "bake" if planned["plan"]["bounces"] is None else "add_bounces"
        tiles = bounce.grouped_tiles(results, last)
        return [Task(f"{_MODULE}:join", {"scene": planned["scene"], "tiles": tiles}, label="join")]

    return [
        Stage("plan", "scene", 3.0, plan),
        Stage("bake", "tiles", 40.0, tiles),
        *bounce.stages(),
        Stage("join", "file", 2.0, join),
    ]


def plan_scene(args: dict[str, Any], store: BlobStore) -> tuple[PlannedScene, Plan]:
    """Load the inputs, factorise the materials, decide effects, parts and tiles."""
    settings = StageSettings.from_dict(args["settings"])
    check_bandwidth(settings.bake)
    mesh, report = load_mesh(store, args["mesh"])
    meshes, specs, names = [mesh], [args["brdf"]], ["object"]
    if args["receiver"] is not None:
        receiver = ReceiverPlane.model_validate(args["receiver"])
        meshes.append(
            receiver_plane(
                mesh.bounds,
                resolution=receiver.resolution,
                extent=receiver.extent,
                gap=receiver.gap,
            )
        )
        material = receiver.brdf or LambertSpec(albedo=receiver.albedo)
        specs.append(material.model_dump(mode="json"))
        names.append("receiver")
    texture = None
    if args["albedo_texture"] is not None:
        _check_texture(specs[0], mesh.uv is not None)
        texture = load_texture(store, args["albedo_texture"])
    scene = Scene.from_parts(meshes, frame_seed=settings.bake.frame_seed)
    requested = Effects.model_validate(args["effects"])
    n_terms = 1 if requested.view_dependence == "off" else settings.bake.n_terms
    factorisations = tuple(
        factorise(
            load_brdf(store, spec),
            n_terms=n_terms,
            energy_lost=settings.bake.term_energy_lost if n_terms is None else None,
        )
        for spec in specs
    )
    part_terms = [factorisation.n_terms for factorisation in factorisations]
    effects = decide_effects(
        meshes,
        scene,
        Accelerator(scene.positions, scene.faces),
        factorisations=factorisations,
        albedo=reflection_of(scene, factorisations, texture)[1],
        bake=settings.bake,
        watertight=bool(report.get("watertight", False)),
        requested=requested,
        seed=args["seed"],
    )
    notes = [factorisation.note for factorisation in factorisations if factorisation.note]
    plan = make_plan(
        scene,
        names,
        part_terms,
        effects,
        settings,
        args["quality"],
        chunk_vertices=transfer_chunk_vertices,
        spectra=[factorisation.singular_values for factorisation in factorisations],
        notes=[*notes, *repairs(report), *report.get("warnings", [])],
    )
    bounces = None
    if plan.bounces is not None:
        bounces = {name: value for name, value in asdict(plan.bounces).items() if name != "blocks"}
    header = {
        "bake": settings.bake.model_dump(mode="json"),
        "bounces": bounces,
        "parts": [
            {"name": name, "material": spec, "occluders": list(part.occluders)}
            for name, spec, part in zip(names, specs, plan.parts, strict=True)
        ],
        "provenance": {
            "inputs": {name: args[name] for name in ("mesh", "brdf", "albedo_texture", "receiver")},
            "bake": settings.bake.model_dump(mode="json"),
            "quality": args["quality"],
            "tiles": [[list(tile) for tile in part.tiles] for part in plan.parts],
            "seed": args["seed"],
            "versions": versions(),
            "effects": [decision.to_dict() for decision in effects],
            "interreflection": bounces,
            "occluders": [list(part.occluders) for part in plan.parts],
        },
    }
    return PlannedScene(scene, factorisations, texture, header), plan


REPAIRS = {
    "unreferenced_vertices": "vertices that no face uses were dropped",
    "duplicate_vertices": "duplicate vertices were merged",
    "degenerate_faces": "faces without area were dropped",
    "duplicate_faces": "duplicate faces were dropped",
    "flipped_faces": "faces were turned over",
}
"""What no warning of the report says; its warnings stand beside these."""


def repairs(report: dict[str, Any]) -> list[str]:
    """Say what parsing had to mend in the mesh."""
    return [f"mesh: {report[name]} {what}" for name, what in REPAIRS.items() if report.get(name)]


def _check_texture(spec: dict[str, Any], has_uv: bool) -> None:
    if spec["model"] != "lambert":
        raise SettingsError(
            "an albedo texture needs a lambert BRDF: it multiplies the whole reflectance",
            pointer="/albedo_texture",
        )
    if not has_uv:
        raise SettingsError(
            "an albedo texture needs texture coordinates, which the mesh lacks",
            pointer="/albedo_texture",
        )


def plan(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: write the planned scene."""
    planned, plan = plan_scene(args, context.store)
    # a basis that cannot be solved fails here, before the first ray
    basis = planned.basis()
    directions = cube_directions(planned.header["bake"]["cube_resolution"])
    projection = basis.projection(directions.directions, directions.weights)
    projected = write_projection(context.scratch / "projection.h5", projection, basis.whitened)
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
        "condition": basis.condition,
        "settings": args["settings"],
    }


def run_tile(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: bake a block of vertices of one part."""
    planned = read_scene(context.store.local_path(args["scene"]))
    bake = planned.header["bake"]
    directions = cube_directions(bake["cube_resolution"])
    occluders = planned.occluders(args["part"])
    factorisation = planned.factorisations[args["part"]]
    projection, basis = read_projection(context.store.local_path(args["projection"]))
    span = args["start"], args["stop"]
    block = bake_block(
        planned.scene,
        occluders,
        span,
        factorisation=factorisation,
        projection=projection,
        directions=directions,
        supersample=bake["supersample"],
        shadows=occluders is not None,
        threads=bake["threads"],
        progress=lambda done, total: context.progress(done, total, "vertices"),
    )
    held_out = held_out_energies(
        planned.scene,
        occluders,
        span,
        block.coefficients,
        factorisation=factorisation,
        basis=basis,
        seed=args["start"],
    )
    packed = quantise_transfer(block.coefficients)
    path = context.scratch / "tile.h5"
    write_transfer_tile(
        path,
        packed.values,
        scale=packed.scale,
        signal_energy=block.signal_energy,
        residual_energy=block.residual_energy,
    )
    areas = planned.scene.areas[args["start"] : args["stop"]]
    return {
        "tile": context.store.put_file(path, move=True),
        "vertices": args["stop"] - args["start"],
        "signal": float(areas @ block.signal_energy),
        "residual": float(areas @ block.residual_energy),
        "rounding": float(areas @ packed.squared_error),
        "held_out_signal": held_out[0],
        "held_out_residual": held_out[1],
        "gram_defect": projection.gram_defect,
        "counters": block.counters() | _self_hits(planned, occluders, args["start"], args["stop"]),
        "epsilon": block.epsilon,
    }


def _self_hits(
    planned: PlannedScene, occluders: Accelerator | None, start: int, stop: int
) -> dict[str, int | float]:
    """Count, on one random ray a vertex, what the ray offset saves from hitting its own surface."""
    if occluders is None:
        return {}
    scene, rng = planned.scene, np.random.default_rng(start)
    rays = rng.standard_normal((stop - start, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    normals = scene.normals[start:stop]
    rays *= np.where((rays * normals).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    epsilon = ray_epsilon(scene.bounds)
    sides = scene.ray_sides[start:stop]
    saved = self_hit_count(
        occluders, scene.positions[start:stop], sides, rays.astype(np.float32), epsilon
    )
    return {"sampled_rays": stop - start, "sampled_rays_saved_from_self_hits": saved}


def join(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: join the tiles into ``transfer.h5``."""
    planned = read_scene(context.store.local_path(args["scene"]))
    scene, bake = planned.scene, planned.header["bake"]
    parts = []
    for index, part in enumerate(planned.header["parts"]):
        start, stop = scene.part_ranges[index]
        factorisation = planned.factorisations[index]
        parts.append(
            TransferPart(
                name=part["name"],
                vertex_range=(start, stop),
                material=part["material"],
                areas=scene.areas[start:stop],
                n_terms=factorisation.n_terms,
                n_channels=1
                if planned.header["bounces"] is None
                else planned.header["bounces"]["n_channels"],
                albedo=factorisation.albedo,
                frames=None if factorisation.is_constant_phi else scene.frames[start:stop],
                albedo_texture=planned.albedo_texture if index == 0 else None,
                factorisation=factorisation.tables(),
            )
        )
    centres, bandwidth = centres_and_bandwidth(bake)
    header = TransferHeader(
        positions=scene.positions,
        faces=scene.faces,
        normals=scene.normals,
        uv=None if scene.uv is None else np.nan_to_num(scene.uv),
        centres=centres,
        bandwidth=bandwidth,
        parts=tuple(parts),
        provenance=planned.header["provenance"] | {"bake": bake},
    )
    path = context.scratch / "transfer.h5"
    join_transfer(path, header, [[context.store.local_path(t) for t in p] for p in args["tiles"]])
    size = path.stat().st_size
    return {"transfer": context.store.put_file(path, move=True), "bytes": size}
