"""Interreflection where scenes are awkward: black, inside out, coincident, tiny, huge, far apart."""

import numpy as np
import pytest

from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.environment.procedural import constant
from prtbake_workers.geometry.loading import load_mesh
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.ray_offset import ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.geometry.teapot import teapot
from prtbake_workers.transport import surface
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bounce_operator import build_bounce_block
from prtbake_workers.transport.bounces import _Series, bounce_block
from prtbake_workers.transport.interreflection import bounce_series
from prtbake_workers.transport.path_material import PathMaterial
from prtbake_workers.transport.path_points import PathPoints
from prtbake_workers.transport.path_tracer import trace_paths
from support.bounce_scenes import ball, bowl, opaque, patch, turned_inside_out


def operator(scene, albedo=None, n_rays=128):
    return build_bounce_block(
        opaque(scene), (0, scene.n_vertices),
        albedo=albedo or Albedo.constant(1.0), n_rays=n_rays, seed=1,
    )  # fmt: skip


def sums(block):
    return np.asarray(block.matrices[0].sum(axis=1))


def traced(scene, vertices, albedo=0.8, n_bounces=3, n_samples=64):
    parts = [PathMaterial(Lambert(np.array([albedo])))] * len(scene.part_ranges)
    return trace_paths(
        opaque(scene), parts,
        PathPoints.of_vertices(scene, vertices, scene.normals[vertices]), constant(16), np.eye(3),
        n_bounces=n_bounces, n_passes=4, n_samples=n_samples, seed=1,
    )  # fmt: skip


def room(n=5, extra=()):
    """A closed room of side 2 made of six walls that share no vertex."""
    return Scene.from_parts(
        [
            patch([-1, -1, 1], [2, 0, 0], [0, 0, -2], n, n),
            patch([-1, 1, -1], [2, 0, 0], [0, 0, 2], n, n),
            patch([-1, -1, -1], [2, 0, 0], [0, 2, 0], n, n),
            patch([1, -1, 1], [-2, 0, 0], [0, 2, 0], n, n),
            patch([-1, -1, 1], [0, 0, -2], [0, 2, 0], n, n),
            patch([1, -1, -1], [0, 0, 2], [0, 2, 0], n, n),
            *extra,
        ]
    )


@pytest.mark.parametrize("channels", [1, 3])
def test_black_surfaces_trace_no_ray_and_change_no_bit(rng, channels):
    scene = Scene.from_parts([bowl(6, 24)])
    block = operator(scene, Albedo.constant(*[0.0] * channels))
    assert block.counters() == dict.fromkeys(block.counters(), 0)
    direct = rng.standard_normal((scene.n_vertices, 9)).astype(np.float32)
    series = bounce_series(direct, block.matrices, areas=scene.areas, tolerance=1e-4, max_bounces=8)
    assert len(series.transfer) == channels
    for channel in series.transfer:
        assert channel.tobytes() == direct.tobytes()
    assert (series.report.n_bounces, series.report.remainder) == (0, 0.0)
    assert series.report.messages == ()
    # paths end where nothing is reflected: one shadow ray and none to go on
    found = traced(scene, np.arange(0, scene.n_vertices, 9), albedo=0.0)
    assert not found.mean.any()
    assert found.n_rays == 0


def test_vertices_inside_another_object_are_black():
    """A small ball wholly within a larger one, and a third that both leave alone."""
    scene = Scene.from_parts([ball(2), ball(1, (0.2, 0.0, 0.1), 0.3), ball(2, (2.5, 0.0, 0.0))])
    block = operator(scene)
    start, stop = scene.part_ranges[1]
    inside = np.arange(start, stop)
    assert not block.escaped[inside].any()
    # what they meet is the back of the larger ball, or nothing that is lit
    lit = np.setdiff1d(np.arange(scene.n_vertices), inside)
    assert block.matrices[0][inside][:, lit].nnz == 0
    direct = block.escaped.astype(np.float32)[:, None]
    series = bounce_series(direct, block.matrices, areas=scene.areas, tolerance=0.0, max_bounces=4)
    assert np.isfinite(series.transfer).all()
    assert not series.transfer[0, inside].any()
    assert series.transfer[0, lit].min() > 0.0
    assert series.report.remainder is not None
    found = traced(scene, inside)
    assert np.isfinite(found.passes).all()
    assert not found.mean.any()
    # the negative twin: beside the larger ball they are lit
    beside = Scene.from_parts([ball(2), ball(1, (1.5, 0.0, 0.1), 0.3)])
    assert operator(beside).escaped[inside].min() > 0.2


def light_patch(height=1.0):
    """A patch of the ceiling's plane that faces down."""
    return patch([-0.3, height, -0.3], [0.6, 0, 0], [0, 0, 0.6], 3, 3)


def test_a_light_in_the_plane_of_the_ceiling_leaks_nothing():
    scene = room(extra=[light_patch()])
    block = operator(scene, n_rays=256)
    assert not block.escaped.any()
    assert block.n_back_hits == 0
    assert sums(block) == pytest.approx(1.0, abs=1e-6)
    # rays from the bare vertices may hit the surface that they start on, and are counted
    assert block.n_probes == scene.n_vertices
    assert block.n_self_hits > 0
    assert block.epsilon == ray_epsilon(scene.bounds)
    # light and ceiling see the same floor: what the patch receives the ceiling under it does
    start, stop = scene.part_ranges[6]
    floor = slice(*scene.part_ranges[0])
    down = np.asarray(block.matrices[0][start:stop][:, floor].sum(axis=1))
    bare = operator(room(), n_rays=256)
    ceiling = slice(*scene.part_ranges[1])
    close = np.abs(scene.positions[ceiling][:, [0, 2]]).max(axis=1) < 0.35
    up = np.asarray(bare.matrices[0][ceiling][:, floor].sum(axis=1))[close]
    # 256 rays: 4e-3; a vertex that looked up out of the room would be at 0
    assert down.mean() == pytest.approx(up.mean(), abs=0.02)
    assert not traced(scene, np.arange(start, stop)).mean.any()


def test_a_light_a_hair_through_the_ceiling_is_still_tight():
    """Half an offset above or below the plane: nothing gets out, whichever surface is met."""
    step = ray_epsilon(room().bounds)
    for height in (1.0 - 0.5 * step, 1.0 + 0.5 * step):
        block = operator(room(extra=[light_patch(height)]))
        assert not block.escaped.any()


@pytest.mark.parametrize("offset", [0.0, 0.5, -0.5], ids=["same plane", "above", "below"])
def test_where_a_front_and_a_back_coincide_the_front_is_seen(monkeypatch, offset):
    """The hole for a light, modelled as a patch of the ceiling that faces up."""
    height = 1.0 + offset * ray_epsilon(room().bounds)
    hole = turned_inside_out(light_patch(height))
    scene = room(extra=[hole])
    indoors = slice(0, scene.part_ranges[6][0])
    block = operator(scene, n_rays=256)
    assert sums(block)[indoors] == pytest.approx(1.0, abs=1e-6)
    vertices = np.arange(0, indoors.stop, 11)
    assert not traced(scene, vertices).mean.any()
    # the negative twin: the first surface met is a black back, more or less often
    monkeypatch.setattr(surface, "COINCIDENT_OFFSETS", -1.0)
    missed = 1.0 - sums(operator(scene, n_rays=256))[indoors]
    assert (missed.max() > 0.02) == (offset <= 0.0)


@pytest.mark.real_data
def test_the_cornell_box_is_tight_but_for_its_opening(data_dir, monkeypatch):
    """Its ceiling, the light and the ceiling's hole, which faces up, lie in one plane."""
    folder = data_dir / "meshes" / "cornell-box"
    names = ("ceiling", "luminaire", "floor", "back", "greenwall", "redwall")
    parts = [load_mesh((folder / f"{name}.obj").read_bytes(), "obj")[0] for name in names]
    scene = Scene.from_parts(parts)
    block = operator(scene, n_rays=1024)
    hole = np.arange(4, 8)
    assert (scene.normals[hole, 1] == 1.0).all()
    assert (block.escaped[hole] == 1.0).all()
    indoors = np.setdiff1d(np.arange(scene.n_vertices), hole)
    assert block.n_back_hits == 0
    assert (sums(block) + block.escaped)[indoors] == pytest.approx(1.0, abs=1e-6)
    light = np.arange(*scene.part_ranges[1])
    # what escapes goes through the open front: more from the edge of the light that is nearer to it
    near = scene.positions[light, 2] < 300.0
    assert block.escaped[light[near]] == pytest.approx(0.224, abs=0.01)
    assert block.escaped[light[~near]] == pytest.approx(0.151, abs=0.01)
    monkeypatch.setattr(surface, "COINCIDENT_OFFSETS", -1.0)
    assert operator(scene, n_rays=1024).n_back_hits > 0


def torus(n=24, m=16):
    """A closed surface that sees itself, counter-clockwise seen from outside."""
    u = 2.0 * np.pi * np.arange(n) / n
    v = 2.0 * np.pi * np.arange(m) / m
    u, v = (grid.ravel() for grid in np.meshgrid(u, v, indexing="ij"))
    reach = 1.0 + 0.4 * np.cos(v)
    positions = np.stack([reach * np.cos(u), 0.4 * np.sin(v), -reach * np.sin(u)], axis=1)
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    a, b = i * m + j, (i + 1) % n * m + j
    c, d = (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return positions, faces


def loaded(positions, faces):
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in positions]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    mesh, report = load_mesh("\n".join(lines).encode(), "obj")
    return mesh, report


@pytest.mark.parametrize("kind", ["inverted", "mixed"])
def test_inverted_and_mixed_winding_bounce_as_the_right_one(rng, kind):
    positions, faces = torus()
    right, _ = loaded(positions, faces)
    wrong = faces[:, ::-1].copy() if kind == "inverted" else faces.copy()
    if kind == "mixed":
        turned = rng.random(len(faces)) < 0.4
        wrong[turned] = wrong[turned, ::-1]
    mended, report = loaded(positions, wrong)
    # of a mixed mesh the loader may turn either share
    assert report.flipped_faces > 0.3 * len(faces)
    expected, found = (operator(Scene.from_parts([mesh])) for mesh in (right, mended))
    assert sums(expected).max() > 0.2
    np.testing.assert_allclose(sums(found), sums(expected), atol=1e-5)
    np.testing.assert_array_equal(found.escaped, expected.escaped)
    # the negative twin: inside out, unrepaired, everything is within the torus and closed
    inner = Mesh(right.positions, right.faces[:, ::-1].copy(), -right.normals)
    assert not operator(Scene.from_parts([inner])).escaped.any()


def moved(mesh, scale=1.0, offset=(0.0, 0.0, 0.0)):
    return Mesh(scale * mesh.positions + np.asarray(offset), mesh.faces, mesh.normals, mesh.uv)


def test_parts_far_apart_do_not_disturb_each_other():
    """Ten thousand diagonals of a part between two of them.

    There float32 resolves a part to 6e-4 of its size and rays start 2 % of it above the surface, so
    what a vertex sees is off by about as much; nothing gets lost.
    """
    one = bowl(8, 32)
    distance = 1e4 * one.diagonal
    scene = Scene.from_parts([one, moved(one, offset=[distance, 0.0, 0.0])])
    block, alone = operator(scene), operator(Scene.from_parts([one]))
    n = one.n_vertices
    matrix = block.matrices[0]
    assert matrix[:n, n:].nnz == 0
    assert matrix[n:, :n].nnz == 0
    for part in (slice(0, n), slice(n, 2 * n)):
        assert np.abs(sums(block)[part] - sums(alone)).mean() < 0.03
        assert sums(block)[part].mean() == pytest.approx(sums(alone).mean(), abs=0.03)
    assert np.isfinite(matrix.data).all()
    series = bounce_series(
        block.escaped.astype(np.float32)[:, None], block.matrices, areas=scene.areas,
        tolerance=1e-9, max_bounces=60,
    )  # fmt: skip
    # what the offset costs in bounces it gives back in direct light: the furnace still closes,
    # but for rays that start on the wrong side of a rim
    assert np.median(np.abs(series.transfer[0, :, 0] - 1.0)) < 1e-3


@pytest.mark.parametrize("scale", [1e-4, 1e4])
@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_the_unit_of_length_does_not_matter(scale, shift):
    parts = [bowl(8, 32), ball(2, (0.0, -0.4, 0.0), 0.35)]
    offset = np.array([shift, -shift, 0.5 * shift])
    plain, other = (
        operator(Scene.from_parts([moved(part, s, s * offset) for part in parts]), n_rays=256)
        for s in (1.0, scale)
    )
    # rays that pass an edge within float32 may meet the neighbour
    assert np.abs(sums(plain) - sums(other)).max() < 0.02
    assert np.abs(sums(plain) - sums(other)).mean() < 2e-4
    differing = np.abs((plain.matrices[0] - other.matrices[0]).data) > 1e-3
    assert differing.sum() < 2e-3 * plain.matrices[0].nnz
    direct = [np.float32(block.escaped)[:, None] for block in (plain, other)]
    areas = np.ones(len(direct[0]))
    one, two = (
        bounce_series(d, b.matrices, areas=s * areas, tolerance=1e-6, max_bounces=40)
        for d, b, s in zip(direct, (plain, other), (1.0, scale**2), strict=True)
    )
    assert one.report.n_bounces == two.report.n_bounces
    assert one.report.remainder == pytest.approx(two.report.remainder, rel=0.01)
    assert np.abs(one.transfer - two.transfer).mean() < 2e-4


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_paths_do_not_know_the_unit_either(scale):
    parts = [bowl(8, 32), ball(2, (0.0, -0.4, 0.0), 0.35)]
    vertices = np.arange(0, 200, 20)
    plain, other = (
        traced(Scene.from_parts([moved(part, s) for part in parts]), vertices) for s in (1.0, scale)
    )
    # the same random numbers: only rays that pass an edge within float32 differ
    assert np.abs(plain.mean - other.mean).max() < 0.01
    assert plain.mean.min() > 0.05


def test_a_closed_white_room_lit_through_a_pinhole_says_that_it_has_no_good_bound():
    """Albedo 1 and light from a few vertices that lie outside: only the message can help."""
    scene = room()
    block = operator(scene)
    direct = np.zeros((scene.n_vertices, 1), np.float32)
    direct[7] = 1.0
    report = bounce_series(
        direct, block.matrices, areas=scene.areas, tolerance=1e-6, max_bounces=5
    ).report
    assert report.remainder is None
    assert not report.converged
    assert any("no bound" in message for message in report.messages)


def glossy_teapot(n_rays, *, seed=3, max_bounces=40, progress=None):
    """A glossy teapot of few vertices: nine tenths of the light goes into a lobe."""
    scene = Scene.from_parts([teapot(3)])
    brdf = factorise(
        CookTorrance(np.array([0.1]), np.array([0.9]), 0.3, np.array([0.5])), n_terms=6
    )
    direct = np.random.default_rng(7).random((scene.n_vertices, brdf.n_terms, 4), np.float32)
    return bounce_block(
        opaque(scene), [direct], factorisations=[brdf], albedo=Albedo.constant(1.0), n_channels=1,
        n_rays=[n_rays], seed=seed, max_bounces=max_bounces, tolerance=1e-9, rounds=[0],
        progress=progress,
    )  # fmt: skip


@pytest.mark.parametrize(("seed", "max_bounces"), [(3, 40), (4, 40), (4, 12), (4, 8), (4, 6)])
def test_bounces_that_grow_by_the_noise_of_few_rays_end_with_the_least(
    monkeypatch, seed, max_bounces
):
    """By a tenth a bounce: of six it is the last ones that tell."""
    found = glossy_teapot(4, seed=seed, max_bounces=max_bounces)
    energies = found.bounce_energies[:, 0]
    assert found.grows
    assert found.remainder_energy is None
    assert len(energies) < max_bounces
    assert np.argmin(energies) == len(energies) - 1
    # what came after it is in no sum
    short = glossy_teapot(4, seed=seed, max_bounces=len(energies))
    assert not short.grows
    assert found.added[0].tobytes() == short.added[0].tobytes()
    assert found.total_energy == short.total_energy
    # left to themselves they do grow
    monkeypatch.setattr(_Series, "_grow", lambda *_, **__: False)
    endless = glossy_teapot(4, seed=seed, max_bounces=max_bounces).bounce_energies[:, 0]
    assert len(endless) == max_bounces
    np.testing.assert_array_equal(endless[: len(energies)], energies)
    assert endless[-1] > 1.05 * energies[-1]


@pytest.mark.parametrize("options", [{}, {"seed": 4, "max_bounces": 6}])
def test_bounces_that_are_found_anew_are_counted_on_and_may_be_stopped(options):
    told = []
    found = glossy_teapot(4, progress=lambda done, most: told.append((done, most)), **options)
    assert found.grows
    anew, most = len(found.bounce_energies), options.get("max_bounces", 40)
    # the one that growth is told by is not, or all would seem done where it is the last
    grown = len(told) - anew
    assert anew <= grown < most
    # no bounce is told twice, and the last one is the last that there was to do
    again = range(grown + 2, grown + 2 + anew)
    assert told == [(done, most) for done in range(1, grown + 1)] + [(n, again[-1]) for n in again]

    def stop(done, most):
        if done > grown:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        glossy_teapot(4, progress=stop, **options)


def test_the_noise_of_bounces_that_grow_is_that_of_those_that_are_added():
    """Against 512 rays; a series of the last two energies would be 40 times the error of one."""
    truth, areas = glossy_teapot(512), Scene.from_parts([teapot(3)]).areas
    for seed in (3, 4):
        found = glossy_teapot(4, seed=seed)
        assert found.grows
        off = ((found.added[0] - truth.added[0]).astype(float) ** 2).sum(axis=(1, 2, 3))
        # a sum over 13 bounces as if surfaces swallowed nothing: 14 times too much, at most
        assert 0.5 * areas @ off < found.noise_energy[0] < 20.0 * areas @ off


def test_enough_rays_do_not_grow():
    enough = glossy_teapot(64)
    assert not enough.grows
    assert enough.remainder_energy is not None
    assert len(enough.bounce_energies) < 40


def plates(lit, max_bounces=10):
    """A white diffuse plate below a lossless glossy one; one of them is lit."""
    scene = Scene.from_parts(
        [
            patch([-1, 0, -1], [0, 0, 2], [2, 0, 0], 6, 6),
            patch([-1, 0.005, -1], [2, 0, 0], [0, 0, 2], 6, 6),
        ]
    )
    shiny = CookTorrance(np.array([1e-3]), np.array([1.0]), 0.15, np.array([1.0]))
    own = [factorise(Lambert(np.array([1.0])), n_terms=1), factorise(shiny, n_terms=20)]
    direct = [
        np.zeros((stop - start, one.n_terms, 1), np.float32)
        for (start, stop), one in zip(scene.part_ranges, own, strict=True)
    ]
    direct[lit][:, 0] = 1.0
    return bounce_block(
        opaque(scene), direct, factorisations=own, albedo=Albedo.constant(1.0), n_channels=1,
        n_rays=[64, 64], seed=3, max_bounces=max_bounces, tolerance=1e-9, rounds=[0, 0],
    )  # fmt: skip


@pytest.mark.parametrize("lit", [0, 1])
def test_light_to_and_fro_between_kinds_of_parts_is_no_growth(monkeypatch, lit):
    """Rows of the two weigh the same light otherwise, so energies rise and fall as it fades."""
    for max_bounces in (10, 9, 4, 3):
        found = plates(lit, max_bounces)
        assert not found.grows
        assert len(found.bounce_energies) == max_bounces
    whole = plates(lit).bounce_energies.sum(axis=1)
    assert (whole[1:] / whole[:-1]).max() > 2.0
    assert (whole[2:] < whole[:-2]).all()
    # the twin: a limit below what the two weights differ by cuts light off
    monkeypatch.setattr("prtbake_workers.transport.bounces.GROWN", 2.0)
    assert plates(lit).grows


@pytest.mark.parametrize(("albedo", "n_bounces"), [(0.99, 600), (1.0, 40), (1.0, 41)])
def test_few_rays_in_a_nearly_lossless_diffuse_room_do_not_grow(rng, albedo, n_bounces):
    """Walls of uneven patches: what each row hands on is a mean of what it sees, in any case."""
    scene = Scene.from_parts(
        [
            patch([-1, -1, 1], [2, 0, 0], [0, 0, -2], 7, 2),
            patch([-1, 1, -1], [2, 0, 0], [0, 0, 2], 1, 3),
            patch([-1, -1, -1], [2, 0, 0], [0, 2, 0], 9, 9),
            patch([1, -1, 1], [-2, 0, 0], [0, 2, 0], 1, 1),
            patch([-1, -1, 1], [0, 0, -2], [0, 2, 0], 2, 5),
            patch([1, -1, -1], [0, 0, 2], [0, 2, 0], 4, 1),
        ]
    )
    direct = [
        rng.random((stop - start, 1, 3)).astype(np.float32) for start, stop in scene.part_ranges
    ]
    white = factorise(Lambert(np.array([1.0])), n_terms=1)
    found = bounce_block(
        opaque(scene), direct, factorisations=[white] * 6, albedo=Albedo.constant(albedo),
        n_channels=1, n_rays=[8] * 6, seed=5, max_bounces=n_bounces, tolerance=0.0,
        rounds=[0] * 6,
    )  # fmt: skip
    assert not found.grows
    assert len(found.bounce_energies) == n_bounces
    mean = scene.areas @ np.concatenate(direct)[:, 0] / scene.areas.sum()
    added = scene.areas @ np.concatenate(found.added)[:, 0, 0] / scene.areas.sum()
    # 8 rays find patches in other shares than their areas: 10 % of the mean of so few vertices
    expected = mean * (albedo ** np.arange(1, n_bounces + 1)).sum()
    if albedo < 1.0:
        np.testing.assert_allclose(expected, mean * albedo / (1.0 - albedo), rtol=0.01)
    np.testing.assert_allclose(added, expected, rtol=0.1)
    assert not np.allclose(added, expected + mean * n_bounces / 4.0, rtol=0.1)
