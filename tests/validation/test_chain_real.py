"""The budget closes on teapot, bunny and spot, at two views and three lights each."""

import pytest

from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.decode.relight import rotation_matrix
from prtbake_workers.jobs import fit_light
from prtbake_workers.jobs.validate import load_validation
from prtbake_workers.validation.chain import validate_camera
from support.local_stages import registered, run_stages
from support.scenes import GLOSSY, asset_request, context_of, run_until

pytestmark = pytest.mark.real_data

CAMERAS = [Camera(), Camera(name="back", azimuth_deg=200.0, elevation_deg=35.0)]
SETTINGS = ValidateSettings(width=96, height=72, passes=6, samples=96, bounce_samples=32)
LIGHTS = ("sun_sky", "kloppenheim", "one_texel_sun")
MESHES = ("teapot", "bunny", "spot")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return open_store((tmp_path_factory.mktemp("real") / "blobs").as_uri())


@pytest.fixture(scope="module")
def lights(store, data_dir):
    """Environment and fitted light by name."""
    blob = store.put_file(data_dir / "environments" / "kloppenheim_05_1k.hdr")
    sources = {
        "sun_sky": {"builtin": {"name": "sun_sky", "width": 128}},
        "kloppenheim": {"blob": blob},
        "one_texel_sun": {"builtin": {"name": "one_texel_sun", "width": 128}},
    }
    fitted = {}
    for name, source in sources.items():
        environment = registered(store, "environment", **source)["canonical"]
        stages = fit_light.stages(environment, FitLightSettings(n_lobes=48, max_iterations=1), 0)
        light = run_stages(stages, store)["fit_light"][0]["light"]
        fitted[name] = {"environment": environment, "light": light}
    return fitted


@pytest.fixture(scope="module")
def assets(store, data_dir):
    """Digests of transfer and asset by mesh, baked once for all lights."""
    meshes = data_dir / "meshes"
    bunny = store.put_file(meshes / "stanford-bunny.obj")
    spot = store.put_file(meshes / "spot" / "spot_triangulated.obj")
    texture = store.put_file(meshes / "spot" / "spot_texture.png")
    scenes = {
        "teapot": ({"builtin": {"name": "teapot", "tessellation": 8}}, {}),
        "bunny": ({"blob": bunny}, {"receiver": {"resolution": 32}}),
        "spot": ({"blob": spot}, {"brdf": {"model": "lambert"}, "albedo_texture": texture}),
    }
    baked = {}
    for name, (mesh, changes) in scenes.items():
        clusters = {"n_clusters": 40 if name == "bunny" else 12, "n_components": 12}
        request = asset_request(**{"brdf": GLOSSY, "settings": {"compress": clusters}} | changes)
        context = context_of(store, request, mesh, {"builtin": {"name": "constant", "width": 16}})
        results = run_until(store, request, context, "quantise")
        baked[name] = {
            "transfer": results["join"][0]["transfer"],
            "exact": results["quantise"][0]["exact"],
            "asset": results["quantise"][0]["asset"],
        }
    return baked


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("mesh", MESHES)
def test_the_budget_closes(store, assets, lights, mesh, light):
    scene = load_validation(assets[mesh] | lights[light], store)
    for index, camera in enumerate(CAMERAS):
        (view,) = validate_camera(
            scene, camera, [rotation_matrix((0.0, 0.0, 0.0))], SETTINGS, seed=index
        )
        budget = view.budget
        assert view.n_hits > 500
        # subtracting estimated noise can move a bound by about that noise, so it must be small
        slack = budget.total_noise
        assert slack < 0.25 * budget.total
        assert budget.total <= budget.sum_of_lines + slack
        assert budget.total + slack >= budget.sum_of_lines / 3
