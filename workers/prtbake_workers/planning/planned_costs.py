"""What the stages of a plan cost: their work, their memory, and the bytes of their files."""

from collections.abc import Collection, Mapping, Sequence
from math import ceil, log

from prtbake_storage.contract.settings import CompressSettings
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.bounce_memory import bounce_memory_bytes
from prtbake_workers.planning.cluster_limit import ClusterLimit
from prtbake_workers.planning.decision import Decision
from prtbake_workers.planning.expected_sizes import expected_sizes
from prtbake_workers.planning.file_bytes import (
    KnownBytes,
    NumberBytes,
    PartNumbers,
    asked_asset_bytes,
    asset_bytes,
    transfer_bytes,
)
from prtbake_workers.planning.planned import BouncePlan, PartPlan
from prtbake_workers.planning.presets import (
    PlannedBake,
    StageSettings,
)
from prtbake_workers.planning.scattering_cost import (
    product_work,
    rows_memory_bytes,
    rows_work,
    scattering_memory_bytes,
)
from prtbake_workers.planning.search_work import searched_work
from prtbake_workers.planning.stage_memory import Lobe
from prtbake_workers.planning.stage_work import (
    bake_work,
    bounce_work,
    quantise_work,
    total,
)


def expected_bounces(decided: Decision, bounces: BouncePlan) -> int:
    """Predict how many bounces the tolerance asks for, from what the first one adds."""
    if bounces.max_bounces == 0:
        return 0
    share = decided.evidence["first_bounce_share"]
    if not 0.0 < share < 1.0 or bounces.tolerance == 0.0:
        return bounces.max_bounces
    return min(bounces.max_bounces, max(1, ceil(log(bounces.tolerance) / log(share))))


def artefact_bytes(
    parts: Sequence[PartPlan],
    known: KnownBytes,
    view_channels: Sequence[int],
    *,
    n_channels: int,
    n_coeffs: int,
    settings: CompressSettings,
    scattering: Collection[int] = (),
    tried: Sequence[NumberBytes | None] = (),
) -> dict[str, int]:
    """Predict the bytes of transfer and assets; parts in ``scattering`` scatter light inside.

    ``tried`` is what numbers of each part were found to take, empty where nothing was tried.
    """
    numbers = [
        PartNumbers(
            n_verts=part.vertex_range[1] - part.vertex_range[0],
            n_rows=n_channels * part.n_terms,
            n_channels=n_channels,
            even=part.role == "receiver" or not part.occluders,
            n_coeffs=n_coeffs,
            factor_floats=part.cost.factor_floats,
            view_columns=part.compression.ranks[0] * channels,
            scattered=index in scattering,
            tried=tried[index] if tried else None,
        )
        for index, (part, channels) in enumerate(zip(parts, view_channels, strict=True))
    ]
    return {
        "transfer.h5": transfer_bytes(known, numbers),
        "asset.h5": asked_asset_bytes(known, numbers, settings),
        "asset-float32.h5": asset_bytes(known, numbers, bits=32),
    }


def work_of_parts(
    parts: Sequence[PartPlan], settings: StageSettings, bake: PlannedBake, *, n_channels: int
) -> dict[str, dict[str, float]]:
    """Count the work of the stages that every part goes through."""
    sizes = [
        {
            "n_verts": part.vertex_range[1] - part.vertex_range[0],
            "n_terms": part.n_terms,
        }
        for part in parts
    ]
    compress = [
        searched_work(
            part.compression,
            settings.compress,
            **size,
            n_coeffs=bake.n_coeffs,
            n_channels=n_channels,
        )
        for part, size in zip(parts, sizes, strict=True)
    ]
    return {
        "bake": total(
            bake_work(bake, **size, shadows=bool(part.occluders), n_tiles=len(part.tiles))
            for part, size in zip(parts, sizes, strict=True)
        ),
        "join": {"tasks": 1.0, "values": sum(own["values"] for own in compress)},
        "compress": total(compress),
        "quantise": total(
            [
                {"tasks": 1.0},
                *(
                    quantise_work(
                        expected_sizes(
                            part.compression,
                            settings.compress.max_error,
                            **size,
                            n_coeffs=bake.n_coeffs,
                            n_channels=n_channels,
                        ),
                        **size,
                        n_coeffs=bake.n_coeffs,
                        factor_floats=part.cost.factor_floats,
                        n_channels=n_channels,
                    )
                    for part, size in zip(parts, sizes, strict=True)
                ),
            ]
        ),
    }


def bounce_costs(
    scene: Scene,
    part_terms: Sequence[int],
    bounces: BouncePlan,
    decided: Decision,
    scattering: Mapping[int, ClusterLimit],
    *,
    medium_channels: Mapping[int, int],
    n_coeffs: int,
    lobes: Sequence[Lobe],
) -> tuple[dict[str, dict[str, float]], dict[str, int]]:
    """Count the work of the stages of bounces and scattering, and predict their memory.

    ``decided`` is the decision on interreflection, with what its probe found.
    """
    n_verts = {part: stop - start for part, (start, stop) in enumerate(scene.part_ranges)}
    n_blocks = len(bounces.blocks)
    n_columns = max(stop - start for start, stop in bounces.blocks)
    expected = expected_bounces(decided, bounces)
    work = {
        "bounces": total(
            [
                bounce_work(
                    tuple(n_verts.values()),
                    part_terms,
                    bounces=expected,
                    n_rays=bounces.n_rays,
                    later_rays=bounces.later_rays,
                    hit_share=decided.evidence["hit_share"],
                    n_channels=bounces.n_channels,
                    n_coeffs=n_coeffs,
                    n_blocks=n_blocks,
                ),
                product_work(
                    n_verts,
                    scattering,
                    times=1 + expected,
                    n_channels=bounces.n_channels,
                    n_coeffs=n_coeffs,
                ),
            ]
        )
    }
    memory = {
        "bounces": bounce_memory_bytes(
            tuple(n_verts.values()),
            part_terms,
            n_rays=bounces.n_rays if bounces.max_bounces else [0] * len(part_terms),
            hit_share=decided.evidence["hit_share"],
            n_channels=bounces.n_channels,
            n_columns=n_columns,
            smoothed=[lobe == "isotropic" and bounces.max_bounces > 0 for lobe in lobes],
            scattering_bytes=scattering_memory_bytes(
                n_verts, scattering, medium_channels, n_columns=n_columns
            ),
        )
    }
    if scattering:
        work["scattering"] = rows_work(n_verts, scattering)
        memory["scattering"] = rows_memory_bytes(n_verts, scattering, medium_channels)
    return work, memory
