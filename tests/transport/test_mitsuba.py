"""The path tracer against Mitsuba 3: same scene, light, camera, bounces and number of paths.

The light is a real overcast sky, of 16 x 32 texels that both hold constant.  ``--log-cli-level=info``
shows the figures measured.
"""

import logging

import numpy as np
import pytest

from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.reading import read_environment
from prtbake_workers.environment.resampling import box_filter
from prtbake_workers.geometry.loading import load_mesh
from prtbake_workers.geometry.receiver import receiver_plane
from support import coloured_box
from support.coloured_box import SUZANNE, WALL_COLOURS

pytestmark = [pytest.mark.real_data, pytest.mark.mitsuba]

LOG = logging.getLogger(__name__)

MOST = 1e-3
"""relMSE of the two pictures, their noise included."""


@pytest.fixture(scope="module")
def overcast(data_dir):
    read, _ = read_environment((data_dir / "environments" / "uffizi.hdr").read_bytes())
    return Environment(box_filter(read.radiance, 16, 32))


def suzanne_in_a_box(data_dir, metal=0.0):
    """Diffuse, or in part rough metal, in a box that is open at the top and in front."""
    from support.mitsuba_render import DiffuseAndMetal, View

    kd = np.array(SUZANNE)
    own = DiffuseAndMetal((1.0 - metal) * kd, metal, 0.2) if metal else Lambert(kd)
    brdfs = [own, *(Lambert(np.array(colour)) for colour in WALL_COLOURS)]
    return (
        coloured_box.suzanne_in_a_box(data_dir, 4),
        brdfs,
        View((0.0, 0.4, 3.4), (0.0, -0.1, 0.0), 38.0, 24, 18),
    )


def bunny_on_a_plane(data_dir):
    """Diffuse and rough metal on a diffuse plane."""
    from support.mitsuba_render import DiffuseAndMetal, View

    mesh, _ = load_mesh((data_dir / "meshes" / "stanford-bunny.obj").read_bytes(), "obj")
    plane = receiver_plane(mesh.bounds, resolution=16, extent=3.0, gap=0.0)
    middle = mesh.bounds.mean(axis=0)
    eye = middle + mesh.diagonal * np.array([0.3, 0.5, 1.8])
    brdfs = [
        DiffuseAndMetal(np.array([0.5, 0.4, 0.3]), 0.3, 0.3),
        Lambert(np.array([0.2, 0.5, 0.7])),
    ]
    return [mesh, plane], brdfs, View(tuple(eye), tuple(middle), 32.0, 32, 24)


def shaderball(data_dir):
    """Diffuse and rough metal, lit by itself in its hollows."""
    from support.mitsuba_render import DiffuseAndMetal, View

    mesh, _ = load_mesh((data_dir / "meshes" / "gltf" / "shaderball.glb").read_bytes(), "glb")
    middle = mesh.bounds.mean(axis=0)
    eye = middle + mesh.diagonal * np.array([0.3, 0.4, 1.5])
    return (
        [mesh],
        [DiffuseAndMetal(np.array([0.45, 0.3, 0.2]), 0.4, 0.3)],
        View(tuple(eye), tuple(middle), 30.0, 28, 21),
    )


def rendered(meshes, brdfs, view, light, n_bounces, n_paths, per_side):
    """Agreement of our picture with Mitsuba's, and of ours without its last bounce."""
    from support.mitsuba_render import Agreement, by_mitsuba, by_paths

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
