import numpy as np
import pytest

from prtbake_storage.contract.settings import AssetSettings, BakeSettings
from prtbake_storage.errors import SettingsError
from prtbake_workers.planning.ladder_steps import (
    LadderStep,
    StepCost,
    ladder_steps,
    neighbours,
    terms_at,
)
from prtbake_workers.planning.presets import LADDER, resolve_stages
from prtbake_workers.planning.step_errors import Resolution, line_factors

SPECTRUM = 0.7 ** np.arange(40.0)


@pytest.mark.parametrize(
    ("quality", "beside"),
    [("draft", ["low"]), ("medium", ["low", "high"]), ("reference", ["high"])],
)
def test_the_steps_beside_one(quality, beside):
    overrides = AssetSettings(compress={"n_clusters": 5})
    found = neighbours(quality, overrides)
    assert list(found) == beside
    for other, settings in found.items():
        assert settings == resolve_stages(other, overrides)
        assert settings.compress.n_clusters == 5


def test_a_step_that_the_overrides_forbid_is_left_out():
    """More passes of so large a picture than are held at a time, at high but not at medium."""
    overrides = AssetSettings(validation={"width": 2048, "height": 2048})
    assert list(neighbours("medium", overrides)) == ["low"]


def count(tolerance):
    """The fewest terms that leave no more than a share of the energy, one by one."""
    energies = [value**2 for value in SPECTRUM]
    return next(n for n in range(1, 41) if sum(energies[n:]) <= tolerance * sum(energies))


@pytest.mark.parametrize("quality", list(LADDER))
def test_terms_are_the_fewest_that_lose_so_little(quality):
    bake = resolve_stages(quality, AssetSettings()).bake
    tolerance = LADDER[quality].bake["term_energy_lost"]
    assert terms_at(3, SPECTRUM, bake, view_dependent=True) == count(tolerance)
    assert count(0.002) > count(0.05)


def test_terms_that_no_tolerance_chooses():
    assert terms_at(3, SPECTRUM, BakeSettings(n_terms=7), view_dependent=True) == 7
    assert terms_at(3, SPECTRUM[:4], BakeSettings(n_terms=7), view_dependent=True) == 4
    assert terms_at(1, SPECTRUM, BakeSettings(term_energy_lost=0.01), view_dependent=False) == 1
    harmonic = BakeSettings(factorisation="sh", view_order=4)
    assert terms_at(16, SPECTRUM, harmonic, view_dependent=True) == 16


def test_what_cannot_be_run_or_is_open_is_left_out():
    own = Resolution(0.01, 6144, 642, 162, 200)
    coarse = Resolution(0.02, 1536, 162, 64, 80)

    def cost_of(terms, settings, quality):
        if quality == "high":
            raise SettingsError("not that")
        return StepCost({"bake": 2.0, "render": 5.0, "validate": 7.0}, 100 * terms[0], coarse)

    steps = neighbours("medium", AssetSettings())
    found = ladder_steps(steps, [3], [SPECTRUM], cost_of, own=own, view_dependent=True)
    factors = line_factors(own, coarse)
    assert found == (LadderStep("low", 2.0, 100 * count(0.02), (count(0.02),), factors),)
    steps = neighbours("medium", AssetSettings(bake={"n_centres": "auto"}))
    assert ladder_steps(steps, [3], [SPECTRUM], cost_of, own=own, view_dependent=True) == ()
