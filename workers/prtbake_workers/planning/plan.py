"""The plan of a job: parts, effects, tiles, and what they are expected to cost."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType

from prtbake_storage.contract.settings import BakeSettings, Quality
from prtbake_storage.decode.asset import Role
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.basis.srbf import default_bandwidth
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.bounce_rays import bounce_rays, later_rays, pilot_tolerance
from prtbake_workers.planning.cluster_limit import ClusterLimit
from prtbake_workers.planning.cost import (
    TILE_SECONDS,
    before_basis_bytes,
    compress_memory_bytes,
    plan_memory_bytes,
    tile_memory_bytes,
    tile_vertices,
)
from prtbake_workers.planning.decision import Decision
from prtbake_workers.planning.expected_sizes import expected_cost
from prtbake_workers.planning.file_bytes import (
    KnownBytes,
    NumberBytes,
    light_bytes,
)
from prtbake_workers.planning.later_stages import later_memory, later_work
from prtbake_workers.planning.planned import BouncePlan, PartPlan, Plan
from prtbake_workers.planning.planned_costs import artefact_bytes, bounce_costs, work_of_parts
from prtbake_workers.planning.presets import (
    PlannedBake,
    StageSettings,
    resolve_compression,
)
from prtbake_workers.planning.rates import Rates
from prtbake_workers.planning.seen_pixels import SeenPixels
from prtbake_workers.planning.stage_memory import (
    Lobe,
    add_bounces_memory_bytes,
    quantise_memory_bytes,
)
from prtbake_workers.planning.stage_work import (
    bounce_work,
    plan_work,
    total,
)
from prtbake_workers.transport.dipole import Dipole

DIRECTIONS_A_FUNCTION = 2.5
"""With fewer the sampled Gram matrix is off the identity by more than 0.05 (RMS over the basis)."""

BLOCK_BYTES = 256 << 20
"""Transfer of all vertices in one block of bounced coefficients; a task holds it four times."""

MOST_BANDWIDTH = 10.0
"""Largest bandwidth in defaults: amid three centres every function has sunk to 7 % of its peak (to
77 % at the default), and what is integrated against them has to be cut ever finer."""


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
    work = bounce_work(
        [stop - start for start, stop in scene.part_ranges],
        part_terms,
        bounces=bake.max_bounces,
        n_rays=n_rays,
        later_rays=later,
        hit_share=by_name["interreflection"].evidence["hit_share"],
        n_channels=n_channels,
        n_coeffs=bake.n_coeffs,
        n_blocks=1,
    )
    # every block casts the rays anew: two are worth it where there is work for two, by the rates
    # that are shipped, since blocks are part of what a job makes
    least = 2 if media or Rates().base_seconds("bounces", work) > TILE_SECONDS else 1
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
    probe_work: Mapping[str, float] = MappingProxyType({}),
    seen: Sequence[SeenPixels] = (),
    known: KnownBytes | None = None,
    view_channels: Sequence[int] = (),
    lobes: Sequence[Lobe] = (),
    tried: Sequence[NumberBytes | None] = (),
) -> Plan:
    """Lay out parts and tiles, count their work, and predict what they hold and leave.

    ``names`` and ``roles`` are those of the scene's parts.
    ``chunk_vertices(n_rows, n_coeffs)`` gives the vertices that tiles must hold multiples of,
    ``spectra`` the singular values of each part's BRDF, ``media`` those of the parts that have one,
    ``scattering`` the parts of these whose scattering is simulated with what its clusters are
    allowed, ``n_oriented`` how many parts have an anisotropic BRDF, ``probe_bytes`` the memory that
    choosing directions or centres took and ``probe_work`` its amounts, ``seen`` what the
    validation's cameras show, ``known`` what is known of the files, ``view_channels`` the channels
    of each part's view side, 1 where none are given, ``lobes`` what their BRDFs are like, ``tried``
    what their factors were found to take a number.
    """
    bake = settings.planned_bake
    simulated = {part: media[part] for part in scattering}
    bounces = plan_bounces(scene, part_terms, effects, bake, simulated, scattering)
    n_channels = 1 if bounces is None else bounces.n_channels
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
                lobe=lobes[index] if lobes else "none",
                occluders=occluders,
                compression=compression,
                tiles=tuple((a, min(a + size, stop)) for a in range(start, stop, size)),
                cost=expected_cost(
                    bake,
                    compression,
                    settings.compress.max_error,
                    n_verts=stop - start,
                    n_terms=n_terms,
                    n_channels=n_channels,
                ),
            )
        )
    work = work_of_parts(parts, settings, bake, n_channels=n_channels)
    work["plan"] = total(
        [
            plan_work(
                bake,
                n_verts=scene.n_vertices,
                n_glossy=max(0, sum(terms > 1 for terms in part_terms) - n_oriented),
                n_oriented=n_oriented,
            ),
            probe_work,
        ]
    )
    memory = {
        "plan": plan_memory_bytes(
            bake,
            probe_bytes=max(probe_bytes, before_basis_bytes(part_terms, n_oriented=n_oriented)),
        ),
        "bake": max(
            tile_memory_bytes(
                bake,
                n_terms=part.n_terms,
                n_verts=max(stop - start for start, stop in part.tiles),
                flat=part.role == "receiver",
            )
            for part in parts
        ),
        "compress": compress_memory_bytes([part.cost for part in parts]),
        "quantise": quantise_memory_bytes(
            [
                (
                    part.vertex_range[1] - part.vertex_range[0],
                    n_channels * part.n_terms * bake.n_coeffs,
                )
                for part in parts
            ]
        ),
    }
    bounced = bounces is not None and bounces.max_bounces > 0
    work |= later_work(
        settings,
        n_verts=[stop - start for start, stop in scene.part_ranges],
        part_terms=part_terms,
        seen=seen,
        baked_bounces=bounced,
    )
    memory |= later_memory(
        settings,
        part_terms=part_terms,
        lobes=[part.lobe for part in parts],
        seen=seen,
        baked_bounces=bounced,
    )
    if bounces is not None:
        (decided,) = (one for one in effects if one.effect == "interreflection")
        added_work, added_memory = bounce_costs(
            scene,
            part_terms,
            bounces,
            decided,
            scattering,
            medium_channels={part: own.n_channels for part, own in media.items()},
            n_coeffs=bake.n_coeffs,
            lobes=[part.lobe for part in parts],
        )
        work |= added_work
        memory |= added_memory
        tiles = sum(len(part.tiles) for part in parts)
        memory["add_bounces"] = max(
            add_bounces_memory_bytes(
                max(stop - start for start, stop in part.tiles),
                n_channels * part.n_terms * bake.n_coeffs,
                n_channels=n_channels,
                n_blocks=len(bounces.blocks),
            )
            for part in parts
        )
        work["add_bounces"] = {"tasks": float(tiles), "values": work["join"]["values"]}
    return Plan(
        parts=tuple(parts),
        effects=tuple(effects),
        bounces=bounces,
        work=work,
        seen=tuple(seen),
        artefact_bytes=artefact_bytes(
            parts,
            known or KnownBytes(0, {16: 0, 32: 0}, (0,) * len(parts)),
            view_channels or [1] * len(parts),
            n_channels=n_channels,
            n_coeffs=bake.n_coeffs,
            settings=settings.compress,
            scattering=bounces.scattering if bounces is not None else (),
            tried=tried,
        )
        | {"light.h5": light_bytes(settings.fit_light)},
        memory_bytes=memory,
        notes=(*notes, *resolution_notes(bake)),
    )
