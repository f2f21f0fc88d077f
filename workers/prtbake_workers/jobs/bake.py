"""Job kind ``bake``: plan, transport tiles, rows of scattering, bounces, join."""

from typing import Any

import numpy as np

from prtbake_storage.contract.settings import Quality
from prtbake_storage.hdf5.transfer import (
    TransferHeader,
    TransferPart,
    join_transfer,
    write_transfer_tile,
)
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.ray_offset import ray_epsilon, self_hit_count
from prtbake_workers.jobs import bounce, plan, scattering
from prtbake_workers.jobs.scene_file import (
    PlannedScene,
    read_projection,
    read_scene,
    stored_basis,
)
from prtbake_workers.planning.presets import StageSettings
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.held_out import held_out_energies
from prtbake_workers.transport.quantise import quantise_transfer

_MODULE = "prtbake_workers.jobs.bake"


def stages(
    request: dict[str, Any], context: dict[str, Any], settings: StageSettings, quality: Quality
) -> list[Stage]:
    """Plan the scene, bake its tiles, scatter and bounce their light, join them."""
    threads = settings.bake.threads
    args = plan.arguments(request, context, settings, quality)

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
        Stage("plan", "scene", 3.0, lambda _: [plan.task(args)]),
        Stage("bake", "tiles", 40.0, tiles),
        scattering.stage(),
        *bounce.stages(),
        Stage("join", "file", 2.0, join),
    ]


def run_tile(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: bake a block of vertices of one part."""
    planned = read_scene(context.store.local_path(args["scene"]))
    bake = planned.header["bake"]
    directions = cube_directions(bake["cube_resolution"])
    occluders = planned.occluders(args["part"])
    factorisation = planned.factorisations[args["part"]]
    stored = read_projection(context.store.local_path(args["projection"]))
    span = args["start"], args["stop"]
    block = bake_block(
        planned.scene,
        occluders,
        span,
        factorisation=factorisation,
        projection=stored.projection,
        product=stored.product,
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
        basis=stored.functions,
        seed=args["start"],
    )
    packed = quantise_transfer(block.coefficients, threads=bake["threads"])
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
        "gram_defect": stored.projection.gram_defect,
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
                role=part["role"],
                two_sided=part["two_sided"],
                vertex_range=(start, stop),
                material=part["material"],
                areas=scene.areas[start:stop],
                n_terms=factorisation.n_terms,
                n_channels=1
                if planned.header["bounces"] is None
                else planned.header["bounces"]["n_channels"],
                albedo=factorisation.albedo,
                frames=None if factorisation.is_constant_phi else scene.frames[start:stop],
                albedo_texture=planned.textures[index],
                subsurface=part["subsurface"],
                vertex_colours=planned.colours[index],
                factorisation=factorisation.tables(),
            )
        )
    header = TransferHeader(
        positions=scene.positions,
        faces=scene.faces,
        normals=scene.normals,
        uv=None if scene.uv is None else np.nan_to_num(scene.uv),
        basis=stored_basis(bake),
        parts=tuple(parts),
        provenance=planned.header["provenance"] | {"bake": bake},
    )
    path = context.scratch / "transfer.h5"
    join_transfer(path, header, [[context.store.local_path(t) for t in p] for p in args["tiles"]])
    size = path.stat().st_size
    return {"transfer": context.store.put_file(path, move=True), "bytes": size}
