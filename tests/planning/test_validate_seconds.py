import pytest

from prtbake_storage.contract.settings import ValidateSettings
from prtbake_workers.planning.cost import validate_seconds


def test_media_cost_paths_of_their_own():
    settings = ValidateSettings()
    options = {"n_terms": 1, "n_dirs": 3072}
    plain = validate_seconds(settings, **options)
    twice = settings.model_copy(update={"bounce_samples": 2 * settings.paths})
    added = [validate_seconds(one, **options, media=True) - plain for one in (settings, twice)]
    assert added[1] == pytest.approx(2.0 * added[0])
    assert added[0] > 0.0


def test_bounces_in_the_reference_cost_paths():
    settings = ValidateSettings()
    options = {"n_terms": 16, "n_dirs": 3072}
    plain = validate_seconds(settings, **options)
    assert validate_seconds(settings, **options, baked_bounces=True) > plain
    asked = settings.model_copy(update={"bounces": 8})
    twice = asked.model_copy(update={"bounce_samples": 2 * asked.paths})
    added = [validate_seconds(each, **options) - plain for each in (asked, twice)]
    assert added[1] == pytest.approx(2.0 * added[0])
    forbidden = settings.model_copy(update={"bounces": 0})
    assert validate_seconds(forbidden, **options, baked_bounces=True) == plain
