"""Fit_light jobs of every method, and what renders, validates and reports their lights."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import RenderSettings, ValidateSettings
from prtbake_storage.decode.light import HarmonicLight, LightFit, WaveletLight
from prtbake_storage.errors import InputError, SettingsError
from prtbake_storage.hdf5.light import read_light
from prtbake_workers.environment.light_error import squared_error_ratio
from prtbake_workers.environment.subdivision import fine_texels
from prtbake_workers.jobs import fit_light, render, report
from prtbake_workers.jobs.lights import light_source, load_light
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.jobs.validate import check_kinship
from prtbake_workers.jobs.work import n_texels
from prtbake_workers.planning.rates import Rates
from prtbake_workers.planning.stage_work import fit_work
from prtbake_workers.validation.chain import validate_camera
from support.local_stages import registered, run_stages
from support.scenes import validation_of


def seconds_of(settings):
    """Predicted by the rates that are shipped."""
    return Rates().all_seconds({"fit_light": fit_work(settings, n_texels=6144)})["fit_light"]


METHODS = {
    "srbf_scattered": ({"n_lobes": 24, "max_iterations": 1}, LightFit, 144),
    "srbf_uniform": ({"n_centres": 42}, LightFit, 126),
    "sh": ({"sh_order": 6}, HarmonicLight, 108),
    "wavelet": ({"resolution": 16, "n_wavelets": 100}, WaveletLight, 300),
}


@pytest.fixture(scope="module")
def environment(store):
    return registered(store, "environment", builtin={"name": "sun_sky", "width": 64})["canonical"]


@pytest.fixture(scope="module")
def fitted(store, environment):
    """What the job of each method returned."""
    results = {}
    for method, (settings, _, _) in METHODS.items():
        stages = fit_light.stages(environment, FitLightSettings(method=method, **settings), 3)
        results[method] = run_stages(stages, store)["fit_light"][0]
    return results


@pytest.mark.parametrize("method", METHODS)
def test_a_job_leaves_a_light_of_its_method(store, environment, fitted, method):
    settings, kind, numbers = METHODS[method]
    result = fitted[method]
    light = read_light(store.local_path(result["light"]))
    assert isinstance(light, kind)
    assert light.method == result["light_method"] == method
    assert result["light_numbers"] == numbers
    assert light.provenance["settings"] == {"method": method, **settings}
    assert result["errors"]["light"] == light.error
    # against the map cut finer than any of the fits cut it
    fine = fine_texels(load_light(store, environment), 0.006)
    # the sun of one texel: its edges lie between samples, of the fit's and of these
    assert squared_error_ratio(light, fine) == pytest.approx(light.error, rel=0.08)
    assert 0.0 < light.error < 1.0
    assert result["power_ratio"] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("method", METHODS)
def test_every_light_is_drawn_and_validated(store, glossy_asset, fitted, method):
    _, context, results = glossy_asset
    digest = fitted[method]["light"]
    inputs = {"asset": results["quantise"][0]["asset"], "light": digest}
    settings = RenderSettings(width=32, height=24, backend="cpu", rotation_deg=(0.0, 40.0, 0.0))
    drawn = run_stages(render.stages(lambda _: inputs, settings), store)["render"][0]
    assert len(drawn["pictures"]) == 2
    scene = validation_of(store, results, context["environment"]["canonical"])
    own = replace(scene, light=read_light(store.local_path(digest)))
    few = ValidateSettings(width=16, height=16, passes=2, samples=8)
    (view,) = validate_camera(own, few.cameras[0], [np.eye(3)], few, seed=0)
    lines = {line.name: line.error for line in view.budget.lines}
    assert 0.0 < lines["light fit"] < 0.5
    if method != "sh":
        return
    # negative twin: under a light twice as bright the line is about 1
    doubled = replace(own.light, coefficients=2.0 * own.light.coefficients)
    (wrong,) = validate_camera(
        replace(own, light=doubled), few.cameras[0], [np.eye(3)], few, seed=0
    )
    assert {line.name: line.error for line in wrong.budget.lines}["light fit"] > 0.7


@pytest.mark.parametrize("method", METHODS)
def test_the_report_tells_what_a_light_is(store, environment, method):
    settings, _, numbers = METHODS[method]
    stages = fit_light.stages(environment, FitLightSettings(method=method, **settings), 3)
    results = run_stages([*stages, report.stage("light")], store)
    numerics = report.summary(results)["numerics"]
    assert numerics["light_method"] == method
    assert numerics["light_numbers"] == numbers
    assert ("lobes" in numerics) == method.startswith("srbf")


@pytest.fixture(scope="module")
def hall(store):
    return registered(store, "environment", builtin={"name": "hall", "width": 32})["canonical"]


def context_of_lights(environment, hall, **light):
    return {
        "environment": {"canonical": environment, "understood": {"width": 64, "height": 32}},
        "lights": [
            {"canonical": hall, "understood": {"width": 32, "height": 16}, "scale": 1.0,
             "rotation_deg": [0.0, 0.0, 0.0]} | light,
        ],
    }  # fmt: skip


def test_several_lights_are_fitted_as_one(store, environment, hall):
    """Harmonics are linear in the light: their sum is the fit of the sum, up to its smaller map."""
    context = context_of_lights(environment, hall, scale=0.5)
    request = {"kind": "fit_light", "environment": f"environment-{'0' * 16}"}
    request["settings"] = {"method": "sh", "sh_order": 6}
    results = run_stages(REGISTRY.stages("fit_light", request, context), store)
    (result,) = results["fit_light"]
    both = read_light(store.local_path(result["light"]))
    apart = [
        run_stages(
            fit_light.stages(digest, FitLightSettings(method="sh", sh_order=6), 0), store
        )["fit_light"][0]
        for digest in (environment, hall)
    ]  # fmt: skip
    first, second = (read_light(store.local_path(one["light"])).coefficients for one in apart)
    # each is integrated in samples of its own map, the hall's in coarser ones; 3e-5 was seen
    scale = np.abs(both.coefficients).max()
    assert np.allclose(both.coefficients, first + 0.5 * second, rtol=0.0, atol=2e-4 * scale)
    assert not np.allclose(both.coefficients, first + second, rtol=0.0, atol=1e-2 * scale)
    assert result["notes"][0].startswith("2 environments shine together")
    assert any("2 environments" in note for note in report.summary(results)["notes"])
    assert n_texels(context) == 64 * 32


def test_a_reference_of_other_lights_is_refused(store, glossy_asset, environment, hall):
    source = light_source(context_of_lights(environment, hall))
    (result,) = run_stages(fit_light.stages(source, FitLightSettings(n_lobes=4), 0), store)[
        "fit_light"
    ]
    *_, results = glossy_asset
    stored = {
        "asset": results["quantise"][0]["asset"],
        "transfer": results["join"][0]["transfer"],
        "light": result["light"],
    }
    check_kinship(stored | {"environment": source}, store)
    dimmer = light_source(context_of_lights(environment, hall, scale=0.9))
    for other in (environment, dimmer):
        with pytest.raises(InputError, match="fitted to another environment"):
            check_kinship(stored | {"environment": other}, store)


def test_one_light_is_named_as_before(environment):
    """Its tasks are those of files that are there."""
    context = {"environment": {"canonical": environment}}
    assert light_source(context) == light_source(context | {"lights": []}) == environment


def test_a_target_is_met_and_told(store, environment):
    settings = FitLightSettings(max_error=0.1, max_iterations=1)
    assert settings.n_lobes == 642
    result = run_stages(fit_light.stages(environment, settings, 0), store)["fit_light"][0]
    assert result["errors"]["light"] <= 0.1
    assert "asked for at most 0.1" in result["notes"][0]


def test_a_target_out_of_reach_fails_with_the_best(store, environment):
    settings = FitLightSettings(max_error=1e-6, n_lobes=16, max_iterations=1)
    with pytest.raises(SettingsError, match=r"cannot be met: 1\d lobes, of at most 16, leave 0"):
        run_stages(fit_light.stages(environment, settings, 0), store)


def test_sizes_of_the_method_that_is_taken_are_settled():
    assert FitLightSettings().model_dump(exclude_none=True) == {
        "method": "srbf_scattered",
        "n_lobes": 162,
        "max_iterations": 6,
    }
    of_others = {
        "srbf_uniform": {"n_centres": 162},
        "sh": {"sh_order": 18},
        "wavelet": {"resolution": 64, "n_wavelets": 324},
    }
    for method, sizes in of_others.items():
        settings = FitLightSettings.model_validate({"method": method})
        assert settings.model_dump(exclude_none=True) == {"method": method} | sizes
        # a dump is a request again
        assert FitLightSettings.model_validate(settings.model_dump()) == settings
        assert seconds_of(settings) > 0.0
    longer = FitLightSettings(method="sh", sh_order=60)
    assert seconds_of(longer) > seconds_of(FitLightSettings(method="sh"))


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"sh_order": 4}, "sh_order is of method 'sh', not of 'srbf_scattered'"),
        ({"method": "sh", "n_lobes": 4}, "n_lobes is of method 'srbf_scattered', not of 'sh'"),
        ({"method": "wavelet", "max_error": 0.1}, "max_error is of method"),
        ({"method": "sh", "bandwidth": 3.0}, "bandwidth is of method 'srbf_uniform'"),
        ({"method": "wavelet", "resolution": 8, "n_wavelets": 385}, "the cube map has 384"),
        ({"method": "srbf_uniform", "n_centres": 100}, "n_centres"),
        ({"max_error": 0.0}, "greater than 0"),
        ({"max_error": 1.0}, "less than 1"),
        ({"method": "fourier"}, "srbf_scattered"),
    ],
)
def test_fields_of_another_method_are_refused(settings, complaint):
    with pytest.raises(ValidationError, match=complaint):
        FitLightSettings.model_validate(settings)
