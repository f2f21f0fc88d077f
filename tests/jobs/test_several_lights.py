"""An asset under two lights: fit, reference and error are of their sum."""

import numpy as np
import pytest

from prtbake_storage.hdf5.light import read_light
from prtbake_workers.environment.environment import LUMINANCE
from prtbake_workers.jobs import report
from prtbake_workers.jobs.lights import light_source, load_light
from support.local_stages import registered
from support.scenes import asset_request, ball_context, run_asset

HALF_TURN = [0.0, 180.0, 0.0]


@pytest.fixture(scope="module")
def lit(store):
    few = {"width": 24, "height": 18, "passes": 2, "samples": 8, "cameras": [{"name": "front"}]}
    request = asset_request(
        receiver=None,
        lights=[{"environment": f"environment-{'1' * 16}", "scale": 3.0}],
        settings={
            "bake": {"n_centres": 42},
            "fit_light": {"n_lobes": 48},
            "render": {"width": 16, "height": 16},
            "validation": few,
        },
    )
    context = ball_context(store, request)
    hall = registered(store, "environment", builtin={"name": "hall", "width": 32})
    context["lights"] = [hall | {"scale": 3.0, "rotation_deg": HALF_TURN}]
    return context, run_asset(store, request, context)


def test_the_fitted_light_has_the_power_of_both(lit, store):
    context, results = lit
    light = read_light(store.local_path(results["fit_light"][0]["light"]))
    both = load_light(store, light_source(context))
    own = load_light(store, context["environment"]["canonical"])
    hall = load_light(store, context["lights"][0]["canonical"])
    fitted, whole, first, second = (
        float(power @ LUMINANCE)
        for power in (
            light.power / (4.0 * np.pi), both.mean_radiance, own.mean_radiance,
            hall.mean_radiance,
        )
    )  # fmt: skip
    # the turned map is resampled
    assert whole == pytest.approx(first + 3.0 * second, rel=5e-3)
    # a fit of few lobes keeps nearly all power; one light alone would be far off
    assert fitted == pytest.approx(whole, rel=0.05)
    assert max(first, 3.0 * second) < 0.9 * whole


def test_the_reference_is_of_both(lit):
    """Against the pictures of one light the asset would be brighter by the other's share."""
    _, results = lit
    (camera,) = results["validate"]
    for view in camera["views"]:
        lines = {line["name"]: line["error"] for line in view["budget"]["lines"]}
        assert lines["light fit"] < 0.1
        assert view["budget"]["total"] < 0.3


def test_the_report_tells_of_both(lit):
    _, results = lit
    notes = report.summary(results)["notes"]
    assert sum("2 environments shine together" in note for note in notes) == 1
