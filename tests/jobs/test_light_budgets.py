"""Bytes and seconds that are asked of a light."""

import pytest
from pydantic import ValidationError

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.errors import SettingsError
from prtbake_workers.jobs import fit_light
from support.local_stages import registered, run_stages


@pytest.fixture(scope="module")
def sky(store):
    return registered(store, "environment", builtin={"name": "sun_sky", "width": 64})["canonical"]


def fitted(store, sky, settings):
    return run_stages(fit_light.stages(sky, settings, 0), store)["fit_light"][0]


def test_lobes_fill_the_bytes_and_never_exceed_them(store, sky):
    asked = 6000
    found = fitted(store, sky, FitLightSettings(max_bytes=asked, max_iterations=1))
    size = store.local_path(found["light"]).stat().st_size
    assert 0.9 * asked <= size == found["bytes"] <= asked
    assert 40 < found["lobes"] < 100


def test_bytes_for_no_lobe_are_refused_with_the_least(store, sky):
    asked = FitLightSettings(max_bytes=100)
    with pytest.raises(SettingsError, match=r"a light of one lobe takes \d+") as refused:
        fitted(store, sky, asked)
    assert refused.value.pointer == "/settings/fit_light/max_bytes"
    # a job of its own has the field elsewhere
    stages = fit_light.stages(sky, asked, 0, settings_at="/settings")
    with pytest.raises(SettingsError) as refused:
        run_stages(stages, store)
    assert refused.value.pointer == "/settings/max_bytes"


def test_without_time_a_light_is_a_first_guess_and_said_so(store, sky):
    hurried = FitLightSettings(n_lobes=24, max_iterations=4, max_seconds=0.01)
    found = fitted(store, sky, hurried)
    assert found["lobes"] == 24
    assert any("max_seconds 0.01 ended" in note for note in found["notes"])
    free = fitted(store, sky, FitLightSettings(n_lobes=24, max_iterations=4))
    assert free["errors"]["light"] < found["errors"]["light"] < 1.0
    held = fitted(store, sky, FitLightSettings(n_lobes=24, max_iterations=4, max_seconds=3600.0))
    assert held["errors"] == free["errors"]
    assert not held["notes"]


def test_an_error_that_time_ends_is_refused_with_what_is_left(store, sky):
    hurried = FitLightSettings(max_error=1e-5, max_iterations=1, max_seconds=0.01)
    with pytest.raises(SettingsError, match="max_seconds ended the search for max_error") as it:
        fitted(store, sky, hurried)
    assert it.value.pointer == "/settings/fit_light/max_seconds"


def test_budgets_are_of_scattered_lobes():
    assert FitLightSettings(max_bytes=10**5).n_lobes == 642
    for field, value in (("max_bytes", 10**5), ("max_seconds", 2.0)):
        with pytest.raises(ValidationError, match=f"{field} is of method"):
            FitLightSettings(method="sh", **{field: value})
        with pytest.raises(ValidationError, match="greater than"):
            FitLightSettings(**{field: 0})
