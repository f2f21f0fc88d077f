"""The page of errors asked for, on a tiny scene, and that it tells what does not hold."""

import pytest

from measured.effect_scenes import EffectScene, builtin, lambert
from measured.targets import Target, measure, page, statements
from prtbake_storage.contract.settings import BakeSettings

SETTINGS = BakeSettings(cube_resolution=6, n_centres=42)
BALL = EffectScene("ball", "a ball", builtin("icosphere", 3), {"brdf": lambert(0.7)})


def test_the_files_of_a_ball_keep_to_their_errors(tmp_path):
    found = measure(BALL, tmp_path, (0.1, 0.01), SETTINGS)
    assert [one.asked for one in found] == [0.1, 0.01]
    assert all(0.9 * one.asked < one.error <= one.asked for one in found)
    assert found[0].n_bytes < found[1].n_bytes
    assert all(holds for holds, _ in statements(found))
    text = page(found, "Measured here.")
    assert "does not hold" not in text
    assert f"| a ball | 10 % | {100 * found[0].error:.4g} % |" in text


@pytest.mark.parametrize(("error", "broken"), [(0.0201, 2), (0.0179, 1), (0.0199, 0)])
def test_a_promise_that_is_broken_is_told(error, broken):
    found = [Target("a ball", 0.02, error, 1000, 1.0)]
    assert sum(not holds for holds, _ in statements(found)) == broken
    assert page(found, "").count("does not hold") == broken
