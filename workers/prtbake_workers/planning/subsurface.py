"""Whether light that scatters inside a part has to leave it elsewhere, or may where it falls.

Without the effect a part with a medium is Lambert with the albedo F R of the medium: what S T tends
to where the transfer T does not change over the way that light takes inside (see
`transport.subsurface`).  A probe of a few vertices' rays and of rows of S gives the squared-error
ratio ``|S T - F R T|^2 / |S T|^2`` that this leaves.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from prtbake_storage.contract.settings import BakeSettings, Switch
from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int64
from prtbake_workers.basis.sh import eval_sh
from prtbake_workers.geometry.mesh import face_area_vectors
from prtbake_workers.geometry.ray_offset import offset_origins
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.cluster_limit import ClusterLimit, choose_solid_angle
from prtbake_workers.planning.decision import Decision, settle
from prtbake_workers.planning.interreflection import PROBE_MARGIN
from prtbake_workers.planning.probe import draw_by_area
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.hemisphere_rays import cosine_directions, lattice, shifted
from prtbake_workers.transport.subsurface import SubsurfaceOperator
from prtbake_workers.transport.surface import OpaqueSurface
from prtbake_workers.transport.triangle_octree import TriangleOctree, build_triangle_octree

EFFECT = "subsurface_scattering"

POINTS = 512
"""Of the surface, drawn by area, where light leaves: not vertices, which lie at edges and corners
more often than the surface does."""

RAYS = 32
"""From every vertex, twice: the product of two halves is free of the noise of either."""

ORDER = 5
"""Of the spherical harmonics that the transfer is held in."""

VERTICES_PER_CHUNK = 8192


@dataclass(frozen=True)
class ScatteringProbe:
    """What leaving scattering out would cost a part, and what its medium looks like from there.

    ``share`` is the squared-error ratio, ``albedo`` F R a channel, ``resolution`` the mean free
    path over the sampling distance.
    """

    share: float
    albedo: tuple[float, ...]
    mean_free_path: tuple[float, ...]
    resolution: tuple[float, ...]
    n_rays: int


@dataclass(frozen=True)
class ScatteringChoice:
    """The decision, the parts that it is taken for, and how large clusters may look in each."""

    decision: Decision
    parts: tuple[int, ...]
    limits: tuple[ClusterLimit, ...]


@dataclass(frozen=True, eq=False)
class _Drawn:
    """A part and its medium, two estimates of its vertices' transfer, and points of its surface."""

    scene: Scene
    dipole: Dipole
    tree: TriangleOctree
    halves: tuple[F32, F32]
    corners: I32
    weights: F64

    @property
    def points(self) -> F64:
        return np.asarray(np.einsum("pc,pci->pi", self.weights, self.scene.positions[self.corners]))


NOTHING_SCATTERS = Decision(
    EFFECT, False, False, "no part has a medium: light leaves where it falls", {}, 0.0
)


def probe_scattering(
    surface: OpaqueSurface, part: int, dipole: Dipole, *, seed: int
) -> ScatteringProbe:
    """Scatter the light of a few rays a vertex, and hold it against the light itself."""
    return _share_left_out(_draw(surface, part, dipole, seed))


def _draw(surface: OpaqueSurface, part: int, dipole: Dipole, seed: int) -> _Drawn:
    rng = np.random.default_rng(seed)
    span = surface.scene.part_ranges[part]
    own = surface.scene.part(part)
    halves = _transfer(surface, span, rng), _transfer(surface, span, rng)
    areas = np.linalg.norm(face_area_vectors(own.positions, own.faces), axis=1)
    triangles = draw_by_area(areas, POINTS, rng)
    weights = _uniform_barycentrics(rng, POINTS)
    tree = build_triangle_octree(own.positions, own.faces)
    return _Drawn(own, dipole, tree, halves, own.faces[triangles], weights)


def _share_left_out(drawn: _Drawn) -> ScatteringProbe:
    own, dipole, transfers = drawn.scene, drawn.dipole, drawn.halves
    corners, weights = drawn.corners, drawn.weights
    operator = SubsurfaceOperator(own, dipole, tree=drawn.tree)
    block = operator.block_at(drawn.points)
    total = wrong = 0.0
    albedo = dipole.diffuse_albedo
    sources = [operator.sources(one) for one in transfers]
    here = [np.einsum("pc,pcb->pb", weights, one[corners]) for one in transfers]
    for channel, matrix in enumerate(block.matrices):
        first, second = (matrix @ one for one in sources)
        total += float((first * second).sum(dtype=np.float64))
        first, second = first - albedo[channel] * here[0], second - albedo[channel] * here[1]
        wrong += float((first * second).sum(dtype=np.float64))
    return ScatteringProbe(
        share=max(wrong, 0.0) / total if total > 0.0 else 0.0,
        albedo=tuple(albedo.tolist()),
        mean_free_path=tuple(dipole.mean_free_path.tolist()),
        resolution=tuple(operator.resolution.tolist()),
        n_rays=2 * RAYS * own.n_vertices,
    )


def _transfer(
    surface: OpaqueSurface, span: tuple[int, int], rng: np.random.Generator
) -> Float32[np.ndarray, "verts coeffs"]:
    """Estimate the diffuse transfer of vertices: the mean of V Y over cosine-distributed rays."""
    scene, pattern = surface.scene, lattice(RAYS)
    found = []
    for start in range(*span, VERTICES_PER_CHUNK):
        own: Int64[np.ndarray, " verts"] = np.arange(
            start, min(start + VERTICES_PER_CHUNK, span[1])
        )
        local = cosine_directions(shifted(pattern, rng.random((len(own), 2))))
        world = (local @ scene.frames[own]).reshape(-1, 3)
        origins = offset_origins(scene.ray_points[own], scene.ray_sides[own], surface.epsilon)
        blocked = surface.accelerator.occluded(
            np.repeat(origins, RAYS, axis=0), world.astype(np.float32)
        )
        basis = eval_sh(ORDER, world) * ~blocked[:, None]
        found.append(basis.reshape(len(own), RAYS, -1).mean(axis=1).astype(np.float32))
    return np.concatenate(found)


def _uniform_barycentrics(rng: np.random.Generator, count: int) -> Float64[F64, "count 3"]:
    u, v = rng.random((2, count))
    root = np.sqrt(u)
    return np.stack([1.0 - root, root * (1.0 - v), root * v], axis=1)


def decide_subsurface(
    surface: OpaqueSurface,
    media: Sequence[Dipole | None],
    bake: BakeSettings,
    switch: Switch,
    *,
    seed: int,
) -> ScatteringChoice:
    """Decide part by part: taken where leaving it out may cost more than the tolerance.

    Parameters
    ----------
    surface
        All parts.
    media
        One a part, None where nothing scatters.
    bake
        Gives ``subsurface_tolerance``.
    switch
        Forces the decision, for all parts with a medium.
    seed
        Of the probes.
    """
    drawn = {
        part: _draw(surface, part, medium, seed + part)
        for part, medium in enumerate(media)
        if medium is not None
    }
    probes = {part: _share_left_out(own) for part, own in drawn.items()}
    if not probes:
        return ScatteringChoice(NOTHING_SCATTERS, (), ())
    chosen = {
        part: settle(switch, PROBE_MARGIN * probe.share > bake.subsurface_tolerance)[0]
        for part, probe in probes.items()
    }
    limits = {
        part: choose_solid_angle(
            own.scene,
            own.dipole,
            0.5 * (own.halves[0] + own.halves[1]),
            own.points,
            tolerance=bake.subsurface_tolerance,
            tree=own.tree,
        )
        for part, own in drawn.items()
        if chosen[part]
    }
    largest = max(probe.share for probe in probes.values())
    reason = (
        f"light that leaves where it falls would miss {largest:.1e} of the scattered light's energy"
    )
    forced = switch != "auto"
    evidence: dict[str, Any] = {
        "tolerance": bake.subsurface_tolerance,
        "probe_points": POINTS,
        "probe_rays": sum(probe.n_rays for probe in probes.values()),
    }
    for name in ("share", "mean_free_path", "resolution", "albedo"):
        evidence[name] = [getattr(probe, name) for probe in probes.values()]
    evidence["clusters"] = [asdict(limit) for limit in limits.values()]
    decision = Decision(
        effect=EFFECT,
        taken=any(chosen.values()),
        forced=forced,
        reason=f"forced {switch}; otherwise: {reason}" if forced else reason,
        evidence=evidence,
        predicted_error_otherwise=largest,
    )
    return ScatteringChoice(decision, tuple(limits), tuple(limits.values()))
