"""The chain of pictures where light bounces: what the stored transfer lacks is one of its lines."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.settings import REFERENCE_BOUNCES, Camera, ValidateSettings
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bounce_operator import build_bounce_block
from prtbake_workers.transport.surface import OpaqueSurface
from prtbake_workers.validation.chain import (
    BOUNCED_LINE,
    LINES,
    MEANINGS,
    N_WITH_PATHS,
    STORED_LINE,
    UNBOUNCED_LINE,
    line_names,
    validate_camera,
)
from support.bounce_scenes import patch
from support.scenes import asset_request, context_of, run_until, validation_of

ALBEDO = (0.8, 0.5, 0.2)
SETTINGS = ValidateSettings(width=48, height=36, passes=8, samples=24, bounce_samples=48)
CAMERA = Camera(azimuth_deg=45.0, elevation_deg=35.0)
STORED = N_WITH_PATHS - 1
"""The line of the stored transfer; the reference has none."""


def obj(*meshes: Mesh) -> bytes:
    """All meshes as one OBJ file."""
    lines, first = [], 1
    for mesh in meshes:
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.positions]
        lines += [f"vn {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.normals]
        lines += ["f " + " ".join(f"{i}//{i}" for i in face) for face in mesh.faces + first]
        first += len(mesh.positions)
    return "\n".join(lines).encode()


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
    """The inside of a corner of three squares under a sky, baked without bounces."""
    store = open_store((tmp_path_factory.mktemp("corner") / "blobs").as_uri())
    mesh = obj(
        patch([0, 0, 1], [1, 0, 0], [0, 0, -1], 8, 8),
        patch([0, 0, 0], [1, 0, 0], [0, 1, 0], 8, 8),
        patch([0, 0, 1], [0, 0, -1], [0, 1, 0], 8, 8),
    )
    path = tmp_path_factory.mktemp("mesh") / "corner.obj"
    path.write_bytes(mesh)
    brdf = {"model": "lambert", "albedo": ALBEDO}
    request = asset_request(brdf=brdf, receiver=None, effects={"interreflection": "off"})
    context = context_of(
        store,
        request,
        {"blob": store.put_file(path)},
        {"builtin": {"name": "sun_sky", "width": 64}},
    )
    results = run_until(store, request, context, "fit_light")
    return validation_of(store, results, context["environment"]["canonical"])


@pytest.fixture(scope="module")
def between_vertices(corner):
    """What of each vertex's light the others receive, at the albedo of each colour."""
    scene = corner.scene
    return build_bounce_block(
        OpaqueSurface(scene, corner.accelerator), (0, scene.n_vertices),
        albedo=Albedo.constant(*ALBEDO), n_rays=1024, seed=3,
    ).matrices  # fmt: skip


def with_bounces(validation, matrices, n_bounces):
    """Stored transfer with bounces between vertices, each colour by a matrix of its own."""
    everything = np.arange(validation.scene.n_vertices)

    def relight_stored(part, vertices, light):
        relit = validation.relight_stored(part, everything, light)
        for colour, matrix in enumerate(matrices):
            bounce = relit[:, 0, colour::3]
            total = bounce.copy()
            for _ in range(n_bounces):
                bounce = matrix @ bounce
                total += bounce
            relit[:, 0, colour::3] = total
        return relit[vertices]

    return replace(validation, relight_stored=relight_stored, baked_bounces=True)


def view_of(validation, seed=1, **changes):
    settings = SETTINGS.model_copy(update=changes)
    (view,) = validate_camera(validation, CAMERA, [np.eye(3)], settings, seed=seed)
    return view


@pytest.fixture(scope="module")
def direct(corner):
    return view_of(corner)


@pytest.fixture(scope="module")
def left_out(corner):
    return view_of(corner, bounces=REFERENCE_BOUNCES)


@pytest.fixture(scope="module")
def bounced(corner, between_vertices):
    return view_of(with_bounces(corner, between_vertices, REFERENCE_BOUNCES))


@pytest.fixture(scope="module")
def once(corner, direct):
    """Light of one bounce."""
    return indirect_of(view_of(corner, bounces=1), direct)


def indirect_of(view, direct):
    return view.chain[0].passes - direct.chain[0].passes


def squared(picture):
    return float((picture**2).sum())


def test_pictures_before_the_stored_one_share_the_indirect_light(direct, left_out):
    indirect = indirect_of(left_out, direct)
    assert squared(indirect.mean(axis=0)) > 0.02 * squared(direct.chain[0].mean)
    for before, after in zip(direct.chain, left_out.chain, strict=True):
        holds = len(after.passes) == SETTINGS.passes
        assert holds == (after.name in LINES[:N_WITH_PATHS])
        expected = before.passes + indirect if holds else before.passes
        np.testing.assert_allclose(after.passes, expected, rtol=1e-12, atol=1e-14)
    # so that no line but the stored transfer's changes
    scale = np.sqrt(direct.budget.squared_norm / left_out.budget.squared_norm)
    for index, line in enumerate(left_out.budget.lines):
        if index != STORED:
            was = direct.budget.lines[index]
            assert line.error == pytest.approx(was.error * scale, rel=1e-9, abs=1e-12)
            assert line.noise == pytest.approx(was.noise * scale, rel=1e-9, abs=1e-12)


def test_bounces_left_out_are_the_share_of_the_indirect_light(direct, left_out):
    line = left_out.budget.lines[STORED]
    indirect = indirect_of(left_out, direct)
    variance = float(indirect.var(axis=0, ddof=1).sum()) / len(indirect)
    share = np.sqrt((squared(indirect.mean(axis=0)) - variance) / left_out.budget.squared_norm)
    # 16 bits of the direct transfer are what they differ by
    assert line.error == pytest.approx(share, rel=1e-3)
    assert line.noise == pytest.approx(np.sqrt(variance / left_out.budget.squared_norm), rel=1e-9)
    assert line.error > 0.15
    assert left_out.budget.total_noise**2 > line.noise**2


def test_baked_bounces_make_the_line_small(corner, between_vertices, left_out, bounced):
    line, share = bounced.budget.lines[STORED], left_out.budget.lines[STORED].error
    # what is left is bounces of light projected on 162 SRBFs, interpolated over cells of 1/8, from
    # 1024 rays: 1.7 % was measured with as much noise, of a share of 18 %
    assert line.error < 0.03
    # the negative twins: bounces cut after the first, and albedo in the wrong channels
    cut = view_of(with_bounces(corner, between_vertices, 1), bounces=REFERENCE_BOUNCES)
    others = [between_vertices[colour] for colour in (1, 2, 0)]
    swapped = view_of(with_bounces(corner, others, REFERENCE_BOUNCES))
    assert 0.2 * share < cut.budget.lines[STORED].error < 0.5 * share
    assert swapped.budget.lines[STORED].error > 0.4 * share


def test_the_noise_of_the_line_is_that_of_the_paths(corner, left_out):
    """Another seed gives another indirect light: their difference is as large as both say."""
    other = view_of(corner, seed=2, bounces=REFERENCE_BOUNCES)
    apart = squared(left_out.chain[STORED].mean - other.chain[STORED].mean)
    said = sum(
        view.budget.lines[STORED].noise ** 2 * view.budget.squared_norm
        for view in (left_out, other)
    )
    # 1800 values from 8 passes each, some lit by the sun alone: within 15 % over four seeds
    assert apart == pytest.approx(said, rel=0.3)


@pytest.mark.parametrize("source", ["texture", "vertices", "both"])
def test_textures_and_vertices_colour_the_indirect_light(corner, direct, once, source):
    """Light of one bounce meets the colour twice; binary fractions, so no texel is rounded."""
    tint = np.array([0.5, 0.25, 1.0], np.float32)
    asset = corner.finest
    part = asset.parts[0]
    if source != "vertices":
        part = replace(part, albedo_texture=tint[None, None])
    if source != "texture":
        part = replace(part, vertex_colours=np.tile(tint, (part.n_vertices, 1)))
    shade = tint.astype(np.float64) ** (2 if source == "both" else 1)
    textured = replace(
        corner,
        exact=replace(asset, parts=(part,), uv=np.zeros((len(asset.positions), 2), np.float32)),
    )
    coloured = view_of(textured, bounces=1).chain[0].passes - shade * direct.chain[0].passes
    # barycentrics are float32, and their sum is 1 within 1e-7
    atol = 1e-12 if source == "texture" else 1e-6 * once.max()
    np.testing.assert_allclose(coloured, shade**2 * once, rtol=1e-9, atol=atol)


def test_the_request_decides_on_the_bounces(corner, direct):
    baked = replace(corner, baked_bounces=True)
    forbidden = view_of(baked, bounces=0)
    assert forbidden.chain[0].passes.tobytes() == direct.chain[0].passes.tobytes()
    assert forbidden.chain[N_WITH_PATHS].name == BOUNCED_LINE
    assert SETTINGS.reference_bounces(baked=True) == REFERENCE_BOUNCES
    assert SETTINGS.reference_bounces(baked=False) == 0
    assert ValidateSettings(bounces=3).reference_bounces(baked=False) == 3
    assert ValidateSettings(samples=7).paths == 1
    assert ValidateSettings(samples=128).paths == 16
    assert ValidateSettings(bounce_samples=5).paths == 5


@pytest.mark.parametrize("merged", [False, True])
def test_every_line_has_a_meaning(corner, merged):
    scene = replace(corner, exact=None) if merged else corner
    stored = {}
    for baked, n_bounces in ((False, 0), (False, 8), (True, 8), (True, 0)):
        names = line_names(replace(scene, baked_bounces=baked), n_bounces)
        assert set(names) <= set(MEANINGS)
        assert len(set(names)) == len(LINES) - merged
        stored[baked, n_bounces] = names[N_WITH_PATHS]
    assert list(stored.values()) == [STORED_LINE, UNBOUNCED_LINE, BOUNCED_LINE, BOUNCED_LINE]


def test_progress_ends_at_one(corner):
    told = []
    settings = SETTINGS.model_copy(update={"bounces": 2, "width": 16, "height": 16, "passes": 2})
    validate_camera(corner, CAMERA, [np.eye(3)] * 2, settings, seed=1, progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
