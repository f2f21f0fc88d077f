"""What goes by what a scene shows: what is said of it, and that jobs teach nothing by it."""

import pytest

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import CompressSettings
from prtbake_workers.planning.uncounted import uncounted, untaught


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"max_error": 0.01}, "2.5 times too many or too few"),
        ({"max_bytes": 10**6}, "ample for the bytes"),
        ({"max_seconds": 5.0}, "ended no fit"),
        ({"classification": "iterative"}, None),
        ({"overdraw_budget": 0.05}, None),
        ({"coherence": 0.05}, None),
    ],
)
def test_what_compression_finds_out_teaches_nothing(settings, said):
    found = uncounted(CompressSettings(**settings))
    assert list(found) == (["compress"] if said else [])
    assert said is None or said in found["compress"]
    assert untaught(CompressSettings(**settings)) == {"compress"}


def test_a_light_of_an_error_is_bounded_and_plain_settings_are_counted():
    target = FitLightSettings(max_error=0.1)
    assert list(uncounted(CompressSettings(), target)) == ["fit_light"]
    assert "all 642, at most" in uncounted(CompressSettings(), target)["fit_light"]
    assert untaught(CompressSettings(), target) == {"fit_light"}
    assert untaught(CompressSettings(coherence=0.0), FitLightSettings()) == set()
