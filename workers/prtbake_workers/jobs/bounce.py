"""Stages ``bounces`` and ``add_bounces`` of a bake: light between surfaces and inside them.

Coefficients do not mix, so a task makes all bounces of some coefficients for the whole scene; what
they add is then laid over the tiles of direct transfer, vertex block by vertex block.  Tiles of
parts that scatter light inside take what leaves them instead.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from prtbake_storage.hdf5.bounces import Packed, read_bounces, read_transfer_tile, write_bounces
from prtbake_storage.hdf5.transfer import write_transfer_tile
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.jobs.scattering import grouped_rows, part_scattering
from prtbake_workers.jobs.scene_file import read_scene
from prtbake_workers.transport.bounces import bounce_block
from prtbake_workers.transport.quantise import quantise_transfer
from prtbake_workers.transport.surface import OpaqueSurface

_MODULE = "prtbake_workers.jobs.bounce"
COARSE = 0.25
"""Mean free path over the distance of vertices below which a note says so."""


def stages() -> list[Stage]:
    """Bounce blocks of coefficients, then lay them over the tiles; no task where none is taken."""

    def bounce(results: Results) -> list[Task]:
        (planned,) = results["plan"]
        bounces = planned["plan"]["bounces"]
        if bounces is None:
            return []
        args = {
            "scene": planned["scene"],
            "tiles": grouped_tiles(results, "bake"),
            "rows": grouped_rows(results),
            "n_rays": bounces["n_rays"],
            "later_rays": bounces["later_rays"],
            "noise_tolerance": bounces["noise_tolerance"],
            "max_bounces": bounces["max_bounces"],
            "tolerance": bounces["tolerance"],
        }
        return [
            Task(
                f"{_MODULE}:run_block",
                {**args, "columns": block},
                label=f"coefficients {block[0]}-{block[1]}",
            )
            for block in bounces["blocks"]
        ]

    def add(results: Results) -> list[Task]:
        (planned,) = results["plan"]
        bounces = planned["plan"]["bounces"]
        if bounces is None:
            return []
        blocks = [
            {"columns": columns, "bounces": block["bounces"]}
            for columns, block in zip(bounces["blocks"], results["bounces"], strict=True)
        ]
        tiles = grouped_tiles(results, "bake")
        return [
            Task(
                f"{_MODULE}:add_bounces",
                {
                    "scene": planned["scene"],
                    "part": index,
                    "start": start,
                    "stop": stop,
                    "tile": tile,
                    "blocks": blocks,
                    "n_channels": bounces["n_channels"],
                },
                label=f"{part['name']} {start}-{stop}",
            )
            for index, part in enumerate(planned["plan"]["parts"])
            for (start, stop), tile in zip(part["tiles"], tiles[index], strict=True)
        ]

    return [
        Stage("bounces", "blocks", 20.0, bounce),
        Stage("add_bounces", "tiles", 5.0, add),
    ]


def grouped_tiles(results: Results, stage: str) -> list[list[str]]:
    """List the digests of a stage's tiles, part by part."""
    done = iter(results[stage])
    parts = results["plan"][0]["plan"]["parts"]
    return [[next(done)["tile"] for _ in part["tiles"]] for part in parts]


def run_block(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: all bounces and all scattering of a block of coefficients."""
    planned = read_scene(context.store.local_path(args["scene"]))
    scene = planned.scene
    start, stop = args["columns"]
    direct = [
        np.concatenate(
            [
                read_transfer_tile(context.store.local_path(tile), slice(start, stop))[0]
                for tile in tiles
            ]
        )
        for tiles in args["tiles"]
    ]
    factorisations, albedo = planned.reflection()
    seed = planned.header["provenance"]["seed"]
    scattering = part_scattering(planned, args["rows"], context.store, context.scratch)
    block = bounce_block(
        OpaqueSurface(scene, Accelerator(scene.positions, scene.traced_faces, robust=True)),
        direct,
        factorisations=factorisations,
        albedo=albedo,
        n_channels=planned.header["bounces"]["n_channels"],
        n_rays=args["n_rays"],
        later_rays=args["later_rays"],
        noise_tolerance=args["noise_tolerance"],
        seed=seed,
        max_bounces=args["max_bounces"],
        tolerance=args["tolerance"],
        scattering=scattering,
        progress=lambda done, total: context.progress(done, total, "bounces"),
    )
    packed, rounding = [], []
    for (first, last), added in zip(scene.part_ranges, block.added, strict=True):
        rows = quantise_transfer(added.reshape(len(added), -1, added.shape[3]))
        rounding.append(float(scene.areas[first:last] @ rows.squared_error))
        packed.append(Packed(rows.values, rows.scale))
    path = context.scratch / "bounces.h5"
    write_bounces(path, packed)
    return {
        "bounces": context.store.put_file(path, move=True),
        "total": block.total_energy.tolist(),
        "energies": block.bounce_energies.tolist(),
        "left_out": None if block.remainder_energy is None else block.remainder_energy.tolist(),
        "is_bound": block.is_bound,
        "grows": block.grows,
        "noise": block.noise_energy.tolist(),
        "rounds": list(block.rounds),
        "n_rays": list(block.n_rays),
        "rounding": rounding,
        "scattering": [
            None
            if own is None
            else {
                # at other vertices in every block
                "error": energy * own.measured_error(direct[part][:, 0], seed=[seed, start]),
                **own.report.to_dict(),
            }
            for part, (own, energy) in enumerate(
                zip(scattering, block.total_energy.tolist(), strict=True)
            )
        ],
        # rays are the same in every block: each reports those it traced
        "counters": block.counters,
    }


def add_bounces(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: lay the bounces over a tile of direct transfer."""
    planned = read_scene(context.store.local_path(args["scene"]))
    direct, energies = read_transfer_tile(context.store.local_path(args["tile"]))
    n_channels = args["n_channels"]
    first = planned.scene.part_ranges[args["part"]][0]
    span = args["start"] - first, args["stop"] - first
    medium = planned.scattering(args["part"])
    total = np.tile(direct, (1, n_channels, 1))
    if medium is not None:
        total[:] = 0.0
    for block in args["blocks"]:
        columns = slice(*block["columns"])
        path = context.store.local_path(block["bounces"])
        total[:, :, columns] += read_bounces(path, args["part"], *span)
    packed = quantise_transfer(total)
    # what the projection lost is direct light's, once a channel, or what a medium gives back of it
    if medium is None:
        gained = _energy(total) - n_channels * _energy(direct)
        signal = n_channels * energies.signal + gained
        residual = n_channels * energies.residual
    else:
        albedo = np.broadcast_to(medium.diffuse_albedo, n_channels)
        residual = float(albedo @ albedo) * energies.residual
        signal = _energy(total) + residual
    path = context.scratch / "tile.h5"
    write_transfer_tile(
        path, packed.values, scale=packed.scale, signal_energy=signal, residual_energy=residual
    )
    areas = planned.scene.areas[args["start"] : args["stop"]]
    return {
        "tile": context.store.put_file(path, move=True),
        "signal": float(areas @ signal),
        "rounding": float(areas @ packed.squared_error),
    }


def _energy(rows: Any) -> Any:
    return np.einsum("vrc,vrc->v", rows, rows, dtype=np.float64)


def errors(results: Results) -> dict[str, float]:
    """Give the squared-error ratios of the bounces over each part's signal, as it is stored.

    ``left out`` bounds what comes after the last bounce where all parts are diffuse, and estimates
    it elsewhere; ``rays`` is what their number leaves to chance, and means over neighbours blur,
    measured at a few vertices; ``scattering`` is what clusters and cut leave of the light that
    scatters inside, measured at a few vertices of its direct light.
    """
    blocks = results["bounces"]
    found: dict[str, float] = {}
    if not blocks:
        return found
    planned = results["plan"][0]["plan"]["bounces"]
    for index, part in enumerate(results["plan"][0]["plan"]["parts"]):
        total = sum(block["total"][index] for block in blocks)
        # where no bounce is simulated there are neither rays nor bounces to leave out
        bounced = (("rays", "noise"), ("left out", "left_out")) if planned["max_bounces"] else ()
        for label, name in (*bounced, ("16-bit", "rounding")):
            if total and all(block[name] is not None for block in blocks):
                share = sum(block[name][index] for block in blocks) / total
                found[f"{part['name']} {label}"] = share
        if total and index in planned["scattering"]:
            share = sum(block["scattering"][index]["error"] for block in blocks) / total
            found[f"{part['name']} scattering"] = share
    return found


def account(results: Results, plan: dict[str, Any]) -> dict[str, Any] | None:
    """Tell what each bounce added to each part, over its energy; None where there was none."""
    if plan["bounces"] is None or not plan["bounces"]["max_bounces"]:
        return None
    blocks = results["bounces"]
    most = max((len(block["energies"]) for block in blocks), default=0)
    added = {}
    for index, part in enumerate(plan["parts"]):
        total = sum(block["total"][index] for block in blocks) or 1.0
        added[part["name"]] = [
            sum(block["energies"][k][index] for block in blocks if k < len(block["energies"]))
            / total
            for k in range(most)
        ]
    return {
        "bounces": most,
        "channels": plan["bounces"]["n_channels"],
        "added": added,
        "left_out": {
            name.removesuffix(" left out"): error
            for name, error in errors(results).items()
            if name.endswith(" left out")
        },
        "left_out_is": _kind_of_left_out(blocks),
    }


def _kind_of_left_out(blocks: Sequence[Mapping[str, Any]]) -> str:
    """Say what is told of later bounces: nothing where one block knows nothing."""
    if any(block["left_out"] is None for block in blocks):
        return "not known"
    return "a bound" if all(block["is_bound"] for block in blocks) else "an estimate"


def scattering_notes(results: Results, plan: dict[str, Any]) -> list[str]:
    """Say of each part that scatters light inside how far, and by how many rows."""
    found = []
    for part in plan["bounces"]["scattering"] if plan["bounces"] else ():
        # every block has the same rows
        report = results["bounces"][0]["scattering"][part]
        paths, resolution, albedo = (
            ", ".join(f"{value:.3g}" for value in report[name])
            for name in ("mean_free_path", "resolution", "albedo")
        )
        name = plan["parts"][part]["name"]
        found.append(
            f"{name} scatters light inside: mean free path {paths} in scene units, {resolution} "
            f"times the distance of vertices; it gives back {albedo} of even light; "
            f"{report['clusters']:.0f} clusters and {report['triangles']:.0f} triangles a vertex"
        )
        if max(report["resolution"]) < COARSE:
            found.append(
                f"{name}: its vertices are far apart for the mean free path; between them light "
                "is interpolated"
            )
    return found


def notes(results: Results, plan: dict[str, Any]) -> list[str]:
    """Say where bounces were cut, or err by more than the tolerance, or nothing bounds the rest."""
    if plan["bounces"] is None or not plan["bounces"]["max_bounces"]:
        return []
    found, blocks, tolerance = [], results["bounces"], plan["bounces"]["tolerance"]
    last = max(
        (
            energy / total
            for block in blocks
            if block["energies"]
            for energy, total in zip(block["energies"][-1], block["total"], strict=True)
            if total
        ),
        default=0.0,
    )
    # of a job that began before blocks told it
    grows = any(block.get("grows", False) for block in blocks)
    if grows:
        found.append(
            "bounces grew, which is the noise of few rays; none after the least of them is added, "
            "and nothing bounds what they leave out: ask for more bounce_rays"
        )
    elif last > tolerance:
        found.append(
            f"bounces stopped at max_bounces = {plan['bounces']['max_bounces']}: the last of them "
            f"added {last:.1e} of the energy, the tolerance is {tolerance:.1e}"
        )
    for index, part in enumerate(plan["parts"]):
        ways = {(block["n_rays"][index], block["rounds"][index]) for block in blocks}
        planned = plan["bounces"]["n_rays"][index]
        for rays, rounds in sorted(ways - {(planned, 0)}):
            fewer = f" in place of {planned}" if rays < planned else ""
            means = f", averaged over neighbours {rounds} time{'s'[: rounds - 1]}" if rounds else ""
            found.append(
                f"{part['name']}: bounced light is that of {rays} rays a vertex{fewer}{means}, "
                "by errors measured at a few vertices"
            )
    measured = errors(results)
    for part in plan["parts"]:
        noise = measured.get(f"{part['name']} rays", 0.0)
        if noise > tolerance > 0.0:
            found.append(
                f"{part['name']}: the bounces' rays leave {noise:.1e} of the energy to chance, the "
                f"tolerance is {tolerance:.1e}: ask for more bounce_rays"
            )
    unknown = [block for block in blocks if block["left_out"] is None]
    if unknown and not grows:
        found.append(
            "nothing bounds what the bounces leave out: hardly any light gets out (albedo near 1 "
            "in a closed space)"
            if all(block["is_bound"] for block in unknown)
            else "nothing tells what the bounces leave out: the last of them brought no less than "
            "the one before; ask for more bounce_rays or max_bounces"
        )
    return found
