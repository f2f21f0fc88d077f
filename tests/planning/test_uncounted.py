"""Which predictions are those of another job: what is said of it, and that jobs teach nothing by it."""

import pytest

from prtbake_storage.contract.settings import CompressSettings, FitLightSettings
from prtbake_workers.planning.uncounted import uncounted


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"max_error": 0.01}, "one fit at the sizes"),
        ({"max_bytes": 10**6}, "ample for the bytes"),
        ({"max_seconds": 5.0}, "ended no fit"),
        ({"classification": "iterative"}, "iterative classification takes"),
        ({"overdraw_budget": 0.05}, "overdraw_budget"),
        ({"coherence": 0.05}, "coherence"),
    ],
)
def test_what_compression_finds_out_is_not_counted(settings, said):
    found = uncounted(CompressSettings(**settings))
    assert list(found) == ["compress"]
    assert said in found["compress"]


def test_a_light_of_an_error_is_not_counted_and_plain_settings_are():
    target = FitLightSettings(max_error=0.1)
    assert list(uncounted(CompressSettings(), target)) == ["fit_light"]
    assert uncounted(CompressSettings(coherence=0.0), FitLightSettings()) == {}
