"""Scenes baked in memory are what a bake job writes; the points of a pixel stand for all of it."""

import numpy as np
import pytest

from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.settings import BakeSettings
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.jobs.inputs import load_brdf
from prtbake_workers.jobs.validate import relight_vertices
from support.baked_scene import SEED, baked, evenly, pixel_of
from support.mitsuba_scenes import View
from support.scenes import asset_request, context_of, relative_difference, run_until

BAKE = {
    "cube_resolution": 8, "n_centres": 42, "n_terms": 6, "bounce_rays": 16, "max_bounces": 2,
    "bounce_tolerance": 0.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """A glossy ball on a red plane: store, and the transfer that a job writes of it."""
    store = open_store((tmp_path_factory.mktemp("baked") / "blobs").as_uri())
    request = asset_request(
        receiver={"resolution": 8, "albedo": [0.8, 0.3, 0.1]}, settings={"bake": BAKE}, seed=SEED,
        effects={"interreflection": "on", "colour_bleeding": "on"},
    )  # fmt: skip
    mesh = {"builtin": {"name": "icosphere", "tessellation": 2}}
    context = context_of(store, request, mesh, {"builtin": {"name": "sun_sky", "width": 32}})
    results = run_until(store, request, context, "join")
    (block,) = results["bounces"]
    return store, store.local_path(results["join"][0]["transfer"]), block["rounds"]


def test_baked_in_memory_is_what_a_job_writes(job, rng):
    store, path, rounds = job
    with open_transfer(path) as transfer:
        header = transfer.header
    meshes = []
    for part in header.parts:
        start, stop = part.vertex_range
        own = (header.faces[:, 0] >= start) & (header.faces[:, 0] < stop)
        meshes.append(
            Mesh(header.positions[start:stop], header.faces[own] - np.int32(start),
                 header.normals[start:stop])
        )  # fmt: skip
    brdfs = [load_brdf(store, dict(part.material)) for part in header.parts]
    scene = baked(meshes, brdfs, BakeSettings.model_validate(BAKE))
    light = rng.random((42, 6))
    lit, direct = scene.relight(light, rounds=rounds), scene.relight(light, bounces=False)
    # every colour of light in the place of the next
    swapped = scene.relight(light[:, [2, 0, 1, 5, 3, 4]], rounds=rounds)
    for index, part in enumerate(header.parts):
        every = np.arange(part.n_vertices)
        written = relight_vertices(path, index, every, light)
        assert part.n_channels == 3
        # 16 bits of the bounces: 2e-5 was measured
        assert relative_difference(lit[index], written) < 1e-4
        # the negative twins: no bounces, and bounces by another colour's albedo
        assert relative_difference(direct[index], written) > 0.01
        back = swapped[index][..., [1, 2, 0, 4, 5, 3]]
        assert relative_difference(back, written) > 0.005


def test_points_are_those_of_their_pixels():
    view = View((0, 0, 1), (0, 0, 0), 40.0, width=3, height=2)
    expected = [[0, 0, 1, 1, 2, 2]] * 2 + [[3, 3, 4, 4, 5, 5]] * 2
    assert pixel_of(np.arange(24), view, 2).tolist() == np.ravel(expected).tolist()


def test_points_chosen_evenly_stand_for_all(rng):
    pixels = rng.integers(0, 5, 400)
    chosen, weights = evenly(pixels, 7)
    assert len(np.unique(chosen)) == len(chosen)
    np.testing.assert_array_equal(np.bincount(pixels[chosen]), 7)
    np.testing.assert_allclose(np.bincount(pixels[chosen], weights), np.bincount(pixels))
    # spread over each pixel's points: a seventh of them apart
    for pixel in range(5):
        places = np.searchsorted(
            np.flatnonzero(pixels == pixel), np.sort(chosen[pixels[chosen] == pixel])
        )
        assert np.diff(places).max() - np.diff(places).min() <= 1
    every, ones = evenly(pixels, 1000)
    np.testing.assert_array_equal(np.sort(every), np.arange(400))
    assert (ones == 1.0).all()
