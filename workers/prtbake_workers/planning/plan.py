"""The plan of a job: parts, effects, tiles, and what they are expected to cost."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from math import ceil, log
from types import MappingProxyType
from typing import Any

from prtbake_storage.contract.settings import BakeSettings, Quality
from prtbake_storage.decode.asset import Role
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.basis.srbf import default_bandwidth
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.bounce_memory import bounce_memory_bytes
from prtbake_workers.planning.bounce_rays import bounce_rays, later_rays, pilot_tolerance
from prtbake_workers.planning.cluster_limit import ClusterLimit
from prtbake_workers.planning.cost import (
    CHILD_START_S,
    ORIENTED_SECONDS,
    PROBE_SECONDS,
    TILE_SECONDS,
    PartCost,
    bounce_seconds,
    compress_memory_bytes,
    compress_seconds,
    fit_seconds,
    part_cost,
    plan_memory_bytes,
    tile_memory_bytes,
    tile_vertices,
    validate_seconds,
)
from prtbake_workers.planning.decision import Decision
from prtbake_workers.planning.ladder_steps import LadderStep
from prtbake_workers.planning.presets import (
    PartCompression,
    PlannedBake,
    StageSettings,
    resolve_compression,
)
from prtbake_workers.planning.scattering_cost import (
    product_seconds,
    rows_memory_bytes,
    rows_seconds,
    scattering_memory_bytes,
)
from prtbake_workers.transport.dipole import Dipole

DIRECTIONS_A_FUNCTION = 2.5
"""With fewer the sampled Gram matrix is off the identity by more than 0.05 (RMS over the basis)."""

BLOCK_BYTES = 256 << 20
"""Transfer of all vertices in one block of bounced coefficients; a task holds it four times."""

MOST_BANDWIDTH = 10.0
"""Largest bandwidth in defaults: amid three centres every function has sunk to 7 % of its peak (to
77 % at the default), and what is integrated against them has to be cut ever finer."""


@dataclass(frozen=True)
class PartPlan:
    """What is done to one part of the scene.

    ``occluders`` lists the parts that may block its light; none means that no ray is traced.
    """

    name: str
    role: Role
    vertex_range: tuple[int, int]
    n_terms: int
    occluders: tuple[int, ...]
    compression: PartCompression
    tiles: tuple[tuple[int, int], ...]
    cost: PartCost


@dataclass(frozen=True)
class BouncePlan:
    """How light that surfaces send to each other, and that scatters inside them, is simulated.

    ``blocks`` are the runs of coefficients that tasks take; ``n_channels`` is 3 where each colour
    has bounces of its own, as ``coloured`` says, or a medium has colours.  ``n_rays`` are those of
    a vertex, part by part, in the first bounce and ``later_rays`` in those after it, at most: fewer
    where one bounce by them is measured to err by less than ``noise_tolerance`` of direct light.
    Parts in ``scattering`` scatter light inside, their clusters within ``solid_angles`` steradians
    each; ``max_bounces`` is 0 where that is all there is.
    """

    n_channels: int
    coloured: bool
    n_rays: tuple[int, ...]
    later_rays: tuple[int, ...]
    noise_tolerance: float
    max_bounces: int
    tolerance: float
    scattering: tuple[int, ...]
    solid_angles: tuple[float, ...]
    blocks: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Plan:
    """All that was decided before the first ray of the bake.

    ``seconds`` of a stage are those of its tasks, added up: its work, not its duration;
    ``memory_bytes`` of a stage those of its largest process, where they are predicted.
    """

    parts: tuple[PartPlan, ...]
    effects: tuple[Decision, ...]
    bounces: BouncePlan | None
    seconds: dict[str, float]
    artefact_bytes: dict[str, int]
    memory_bytes: dict[str, int]
    notes: tuple[str, ...]
    ladder: tuple[LadderStep, ...] = ()
    """Of an asset, the qualities beside its own."""

    @property
    def peak_memory_bytes(self) -> int:
        """Memory of the largest process."""
        return max(self.memory_bytes.values())

    def to_dict(self) -> dict[str, Any]:
        """Give the plan as JSON."""
        return asdict(self)


def occluders_of(part: int, roles: Sequence[Role], effects: Sequence[Decision]) -> tuple[int, ...]:
    """List the parts whose triangles may block light on its way to ``part``.

    All parts of an object are one shape: each is shadowed by all of them, or by none.  A receiver
    is a plane, which does not shadow itself.
    """
    taken = {decision.effect: decision.taken for decision in effects}
    own = roles[part]
    return tuple(
        other
        for other, role in enumerate(roles)
        if taken["self_shadowing" if own == role else "receiver_shadows"]
        and not own == role == "receiver"
    )


def check_bandwidth(bake: BakeSettings) -> None:
    """Refuse a bandwidth with holes between the centres; the basis itself refuses too small a one.

    Raises
    ------
    SettingsError
        It is more than `MOST_BANDWIDTH` times the default for so many centres.
    """
    if bake.bandwidth is None or not isinstance(bake.n_centres, int):
        return
    default = default_bandwidth(bake.n_centres)
    if bake.bandwidth > MOST_BANDWIDTH * default:
        raise SettingsError(
            f"bandwidth {bake.bandwidth:g} is too large for {bake.n_centres} centres, which leave "
            f"holes between them: at most {MOST_BANDWIDTH * default:g}, the default is {default:g}",
            pointer="/settings/bake/bandwidth",
        )


def resolves(cube_resolution: int, n_functions: int) -> bool:
    """Tell whether the directions are enough to tell the basis functions apart."""
    return 6 * cube_resolution**2 >= DIRECTIONS_A_FUNCTION * n_functions


def resolution_notes(bake: PlannedBake) -> list[str]:
    """Say so where the directions are too few to tell the basis functions apart."""
    if resolves(bake.cube_resolution, bake.n_coeffs):
        return []
    functions = "SRBFs" if bake.basis == "srbf" else "spherical harmonics"
    return [
        f"{6 * bake.cube_resolution**2} directions do not resolve {bake.n_coeffs} {functions}: the "
        "projection fits its samples and errs between them; "
        f"{DIRECTIONS_A_FUNCTION:g} directions a function are the least"
    ]


def plan_bounces(
    scene: Scene,
    part_terms: list[int],
    effects: list[Decision],
    bake: PlannedBake,
    media: Mapping[int, Dipole],
    limits: Mapping[int, ClusterLimit],
) -> BouncePlan | None:
    """Cut the coefficients into blocks of about `BLOCK_BYTES`; two at least, unless that is quick.

    ``media`` and ``limits`` are those of the parts that scatter.
    """
    by_name = {decision.effect: decision for decision in effects}
    bounced = by_name["interreflection"].taken
    if not (bounced or media):
        return None
    coloured = by_name["colour_bleeding"].taken
    n_rays = bounce_rays(by_name["interreflection"], bake)
    n_channels = 3 if coloured else max((own.n_channels for own in media.values()), default=1)
    later = later_rays(by_name["interreflection"], bake, n_rays)
    rows = sum(
        (stop - start) * n_terms
        for (start, stop), n_terms in zip(scene.part_ranges, part_terms, strict=True)
    )
    fitting = max(1, BLOCK_BYTES // (4 * n_channels * rows))
    seconds = bounce_seconds(
        scene,
        part_terms,
        bounces=bake.max_bounces,
        n_rays=n_rays,
        later_rays=later,
        hit_share=by_name["interreflection"].evidence["hit_share"],
        n_channels=n_channels,
        n_coeffs=bake.n_coeffs,
        n_blocks=1,
    )
    # every block casts the rays anew: two are worth it where there is work for two
    least = 2 if media or seconds > TILE_SECONDS else 1
    n_blocks = max(min(least, bake.n_coeffs), -(-bake.n_coeffs // fitting))
    edges = [round(i * bake.n_coeffs / n_blocks) for i in range(n_blocks + 1)]
    return BouncePlan(
        n_channels=n_channels,
        coloured=coloured,
        n_rays=n_rays,
        later_rays=later,
        noise_tolerance=pilot_tolerance(by_name["interreflection"], bake),
        max_bounces=bake.max_bounces if bounced else 0,
        tolerance=bake.bounce_tolerance,
        scattering=tuple(sorted(limits)),
        solid_angles=tuple(limits[part].solid_angle for part in sorted(limits)),
        blocks=tuple(pairwise(edges)),
    )


def expected_bounces(decided: Decision, bounces: BouncePlan) -> int:
    """Predict how many bounces the tolerance asks for, from what the first one adds."""
    if bounces.max_bounces == 0:
        return 0
    share = decided.evidence["first_bounce_share"]
    if not 0.0 < share < 1.0 or bounces.tolerance == 0.0:
        return bounces.max_bounces
    return min(bounces.max_bounces, max(1, ceil(log(bounces.tolerance) / log(share))))


def make_plan(
    scene: Scene,
    names: Sequence[str],
    part_terms: list[int],
    effects: list[Decision],
    settings: StageSettings,
    quality: Quality,
    *,
    roles: Sequence[Role],
    chunk_vertices: Callable[[int, int], int],
    spectra: Sequence[Float64[F64, " _"]],
    notes: list[str],
    media: Mapping[int, Dipole] = MappingProxyType({}),
    scattering: Mapping[int, ClusterLimit] = MappingProxyType({}),
    n_oriented: int = 0,
    probe_bytes: int = 0,
) -> Plan:
    """Lay out parts and tiles and predict their cost.

    ``names`` and ``roles`` are those of the scene's parts.
    ``chunk_vertices(n_rows, n_coeffs)`` gives the vertices that tiles must hold multiples of,
    ``spectra`` the singular values of each part's BRDF, ``media`` those of the parts that have one,
    ``scattering`` the parts of these whose scattering is simulated with what its clusters are
    allowed, ``n_oriented`` how many parts have an anisotropic BRDF, ``probe_bytes`` the memory that
    choosing directions or centres took.
    """
    bake = settings.planned_bake
    simulated = {part: media[part] for part in scattering}
    bounces = plan_bounces(scene, part_terms, effects, bake, simulated, scattering)
    n_channels = 1 if bounces is None else bounces.n_channels
    probed = any(one.effect == "light_resolution" for one in effects)
    parts = []
    for index, (name, n_terms) in enumerate(zip(names, part_terms, strict=True)):
        start, stop = scene.part_ranges[index]
        occluders = occluders_of(index, roles, effects)
        compression = resolve_compression(
            settings.compress,
            quality,
            n_verts=stop - start,
            n_terms=n_terms,
            n_coeffs=bake.n_coeffs,
            n_channels=n_channels,
            singular_values=spectra[index],
        )
        size = tile_vertices(
            bake,
            n_terms=n_terms,
            shadows=bool(occluders),
            chunk=chunk_vertices(n_channels * n_terms, bake.n_coeffs),
            n_channels=n_channels,
        )
        parts.append(
            PartPlan(
                name=name,
                role=roles[index],
                vertex_range=(start, stop),
                n_terms=n_terms,
                occluders=occluders,
                compression=compression,
                tiles=tuple((a, min(a + size, stop)) for a in range(start, stop, size)),
                cost=part_cost(
                    bake,
                    compression,
                    n_verts=stop - start,
                    n_terms=n_terms,
                    shadows=bool(occluders),
                    iterations=settings.compress.max_iterations,
                    n_channels=n_channels,
                ),
            )
        )
    tiles = sum(len(part.tiles) for part in parts)
    seconds = {
        "plan": CHILD_START_S
        + 2.0
        + n_oriented * ORIENTED_SECONDS
        + (PROBE_SECONDS if probed else 0.0),
        # as the report measures it: summed over the tiles, whose threads work side by side
        "bake": tiles * CHILD_START_S
        + sum(part.cost.bake_seconds for part in parts) / bake.threads,
        "compress": compress_seconds([part.cost for part in parts]),
        "fit_light": fit_seconds(settings.fit_light),
        "render": 5.0,
        "validate": validate_seconds(
            settings.validation,
            n_terms=max(part_terms),
            n_dirs=3 * bake.cube_resolution**2,
            baked_bounces=bounces is not None and bounces.max_bounces > 0,
            media=bool(media),
        ),
    }
    memory = {
        "plan": plan_memory_bytes(bake, oriented=n_oriented > 0, probe_bytes=probe_bytes),
        "bake": max(
            tile_memory_bytes(
                bake,
                n_terms=part.n_terms,
                n_verts=max(stop - start for start, stop in part.tiles),
            )
            for part in parts
        ),
        "compress": compress_memory_bytes([part.cost for part in parts]),
    }
    if bounces is not None:
        (decided,) = (one for one in effects if one.effect == "interreflection")
        added_seconds, added_memory = _bounce_costs(
            scene,
            part_terms,
            bounces,
            decided,
            scattering,
            medium_channels={part: own.n_channels for part, own in media.items()},
            n_coeffs=bake.n_coeffs,
        )
        seconds |= added_seconds
        memory |= added_memory
    return Plan(
        parts=tuple(parts),
        effects=tuple(effects),
        bounces=bounces,
        seconds=seconds,
        artefact_bytes={
            "transfer.h5": sum(part.cost.transfer_bytes for part in parts),
            "asset.h5": sum(part.cost.asset_bytes for part in parts),
        },
        memory_bytes=memory,
        notes=(*notes, *resolution_notes(bake)),
    )


def _bounce_costs(
    scene: Scene,
    part_terms: Sequence[int],
    bounces: BouncePlan,
    decided: Decision,
    scattering: Mapping[int, ClusterLimit],
    *,
    medium_channels: Mapping[int, int],
    n_coeffs: int,
) -> tuple[dict[str, float], dict[str, int]]:
    """Predict seconds and memory of the stages of bounces and scattering.

    ``decided`` is the decision on interreflection, with what its probe found.
    """
    n_verts = {part: stop - start for part, (start, stop) in enumerate(scene.part_ranges)}
    n_blocks = len(bounces.blocks)
    n_columns = max(stop - start for start, stop in bounces.blocks)
    expected = expected_bounces(decided, bounces)
    seconds = {
        "bounces": product_seconds(
            n_verts,
            scattering,
            times=1 + expected,
            n_channels=bounces.n_channels,
            n_coeffs=n_coeffs,
        )
    }
    if bounces.max_bounces:
        seconds["bounces"] += bounce_seconds(
            scene,
            part_terms,
            bounces=expected,
            n_rays=bounces.n_rays,
            later_rays=bounces.later_rays,
            hit_share=decided.evidence["hit_share"],
            n_channels=bounces.n_channels,
            n_coeffs=n_coeffs,
            n_blocks=n_blocks,
        )
    else:
        seconds["bounces"] += n_blocks * CHILD_START_S
    memory = {
        "bounces": bounce_memory_bytes(
            tuple(n_verts.values()),
            part_terms,
            n_rays=bounces.n_rays if bounces.max_bounces else [0] * len(part_terms),
            hit_share=decided.evidence["hit_share"],
            n_channels=bounces.n_channels,
            n_columns=n_columns,
            scattering_bytes=scattering_memory_bytes(
                n_verts, scattering, medium_channels, n_columns=n_columns
            ),
        )
    }
    if scattering:
        seconds["scattering"] = rows_seconds(n_verts, scattering)
        memory["scattering"] = rows_memory_bytes(n_verts, scattering, medium_channels)
    return seconds, memory
