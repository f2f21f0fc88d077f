"""The path tracer and baked results against Mitsuba 3: same scene, light, camera and bounces.

The path tracer takes as many paths; what is baked is compared before its compression.  The light is a
real overcast sky, of 16 x 32 texels that all hold constant.  ``--log-cli-level=info`` shows the
figures measured.
"""

import logging

import pytest

from prtbake_storage.contract.settings import BakeSettings, ValidateSettings
from support.agreement import Agreement, Explained
from support.baked_scene import baked, pixel_chain, validation_of_baked
from support.mitsuba_scenes import bunny_on_a_plane, overcast_sky, shaderball, suzanne_in_a_box

pytestmark = [pytest.mark.real_data, pytest.mark.mitsuba]

LOG = logging.getLogger(__name__)

MOST = 1e-3
"""relMSE of the two pictures, their noise included."""


@pytest.fixture(scope="module")
def overcast(data_dir):
    return overcast_sky(data_dir)


def rendered(meshes, brdfs, view, light, n_bounces, n_paths, per_side):
    """Agreement of our picture with Mitsuba's, and of ours without its last bounce."""
    from support.mitsuba_render import by_mitsuba, by_paths

    theirs, corners = by_mitsuba(meshes, brdfs, light, view, n_bounces, n_paths=n_paths)
    ours, fewer = by_paths(
        meshes, brdfs, light, view, n_bounces, corners, n_paths=n_paths, per_side=per_side
    )
    return Agreement.between(ours, theirs), Agreement.between(fewer, theirs)


@pytest.mark.parametrize(
    ("scene", "n_bounces", "n_paths", "per_side", "beyond_noise"),
    [
        (suzanne_in_a_box, 3, 4096, 4, 5e-4),
        (bunny_on_a_plane, 2, 2304, 8, 2e-4),
        (shaderball, 2, 4096, 8, 2e-4),
    ],
    ids=["suzanne", "bunny", "shaderball"],
)
def test_rel_mse(data_dir, overcast, scene, n_bounces, n_paths, per_side, beyond_noise):
    """At equal light paths, with the smooth normals of the files; their noise is counted in.

    Where smooth normals lean away from a coarse surface the two rightly differ: a direction above
    the shading horizon but below the face is lost in Mitsuba, and is reflected once more by that
    face here, so that a furnace stays white.  On suzanne's 507 vertices that is most of what is left
    beyond the noise, and 0.8 % of the light.
    """
    meshes, brdfs, view = scene(data_dir)
    found, fewer = rendered(meshes, brdfs, view, overcast, n_bounces, n_paths, per_side)
    LOG.info("%s; without its last bounce %.2e", found, fewer.rel_mse)
    assert found.rel_mse < MOST
    assert found.rel_mse - found.noise < beyond_noise
    assert abs(found.ratio - 1.0) < 0.012
    # the negative twin: the same paths without their last bounce
    assert fewer.rel_mse > 1.5 * MOST


@pytest.mark.parametrize("n_bounces", [0, 3], ids=["direct", "bounces"])
def test_flat_faces_leave_nothing_but_noise(data_dir, overcast, n_bounces):
    """Without smooth normals the two renderers solve one equation, glossy surfaces included."""
    from support.mitsuba_render import faceted

    meshes, brdfs, view = suzanne_in_a_box(data_dir, metal=0.4)
    meshes = [faceted(mesh) for mesh in meshes]
    found, fewer = rendered(meshes, brdfs, view, overcast, n_bounces, 1024, 4)
    LOG.info("%s", found)
    assert found.noise < 3e-3
    # the noise is known from four parts a picture, and a few of 432 pixels hold much of it
    assert found.rel_mse < 1.4 * found.noise
    assert abs(found.ratio - 1.0) < 4.0 * found.ratio_error + 3e-4
    # the negative twin
    assert abs(fewer.ratio - 1.0) > 8.0 * found.ratio_error


def test_the_budget_explains_the_baked_result(data_dir, overcast):
    """Uncompressed, at the settings of a draft, relit by the projected and by the fitted light.

    The budget is that of validation, drawn up without Mitsuba: it bounds how far the baked picture
    is from Mitsuba's.
    """
    from support.mitsuba_render import by_mitsuba

    meshes, brdfs, view = suzanne_in_a_box(data_dir)
    theirs, _ = by_mitsuba(meshes, brdfs, overcast, view, 3, n_paths=4608, n_parts=8)
    settings = BakeSettings(n_centres=162, cube_resolution=16, max_bounces=3, bounce_tolerance=0.0)
    scene = baked(meshes, brdfs, settings)
    sampling = ValidateSettings(passes=8, samples=128, bounces=3, bounce_samples=16)
    chain = pixel_chain(validation_of_baked(scene, overcast, 64), view, 4, sampling)
    for pictures in (chain[:-1], chain):
        found = Explained.of(theirs, pictures)
        LOG.info("%s", found)
        assert found.slack < 0.25 * found.budget.total
        assert found.is_bound
        assert found.is_tight
        # the reference is the smaller part of it
        assert found.budget.lines[0].error < 0.5 * found.budget.total
        assert found.budget.total <= found.own.sum_of_lines + found.slack
        assert found.budget.total >= found.own.sum_of_lines / 3.0 - found.slack
        # a coarse bake is not at the path tracer's 1e-3
        assert MOST < found.agreements[-1].rel_mse < 10.0 * MOST
    # the negative twin: a bake without bounces is farther off than the budget of the other allows
    cheap = ValidateSettings(passes=2, samples=1, bounces=0)
    direct = pixel_chain(validation_of_baked(scene, overcast, 8, bounces=False), view, 4, cheap)
    wrong = Explained.of(theirs, [chain[0], direct[-2]])
    LOG.info("%s", wrong)
    assert wrong.budget.total > 1.5 * (found.own.sum_of_lines + found.slack)
