"""A BRDF without a lobe is a Lambertian one, whatever its model: through to the picture."""

import numpy as np
import pytest

from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_workers.validation.chain import validate_camera
from support.scenes import asset_request, context_of, relative_difference, run_until, validation_of

KD = (0.3, 0.1, 0.6)
SETTINGS = ValidateSettings(width=48, height=36, passes=4, samples=64)


def view_of(store, brdf):
    request = asset_request(brdf=brdf, receiver=None, settings={"bake": {"n_centres": 42}})
    context = context_of(
        store,
        request,
        {"builtin": {"name": "icosphere", "tessellation": 2}},
        {"builtin": {"name": "sun_sky", "width": 64}},
    )
    results = run_until(store, request, context, "fit_light")
    validation = validation_of(store, results, context["environment"]["canonical"])
    (view,) = validate_camera(validation, Camera(), [np.eye(3)], SETTINGS, seed=1)
    return view


@pytest.fixture(scope="module")
def lambert(store):
    return view_of(store, {"model": "lambert", "albedo": KD})


@pytest.mark.parametrize("model", ["phong", "blinn_phong", "cook_torrance", "ggx"])
def test_a_model_without_its_lobe_gives_the_diffuse_picture(store, lambert, model):
    view = view_of(store, {"model": model, "kd": KD, "ks": 0.0})
    # kd / pi against albedo / pi: float64 sums of one and the same light
    assert relative_difference(view.reference, lambert.reference) < 1e-6
    # one rounding of kd to float32
    assert relative_difference(view.delivered, lambert.delivered) < 1e-6
    # and not only alike: 42 SRBFs on a sphere are within a tenth of the reference
    assert view.budget.total < 0.1
    # negative twin: what multiplies the colours is seen in the picture
    assert relative_difference(view.delivered / np.array(KD), lambert.delivered) > 0.5
