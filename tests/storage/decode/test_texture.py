"""Albedo textures."""

import numpy as np

from prtbake_storage.decode.texture import linear_to_srgb, lookup_repeating, srgb_to_linear


def test_rows_run_down_and_v_runs_up() -> None:
    texture = np.array([[[1.0], [2.0]], [[3.0], [4.0]]], np.float32)
    at = np.array([[0.25, 0.75], [0.75, 0.75], [0.25, 0.25], [0.75, 0.25]])
    assert lookup_repeating(texture, at)[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert lookup_repeating(texture, at + np.array([3.0, -2.0]))[:, 0].tolist() == [
        1.0,
        2.0,
        3.0,
        4.0,
    ]
    # the border mixes both sides: that is what repeating means
    assert lookup_repeating(texture, np.array([[0.0, 0.75]]))[0, 0] == 1.5
    assert lookup_repeating(texture, np.array([[0.5, 0.5]]))[0, 0] == 2.5


def test_srgb_and_back() -> None:
    codes = np.arange(256) / 255.0
    # float32 of numbers up to 1
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(codes)), codes, atol=1e-6)
    # the standard's own figure for 50 % grey
    assert abs(float(srgb_to_linear(np.array(0.5))) - 0.21404) < 1e-5
    assert np.abs(codes**2.2 - srgb_to_linear(codes)).max() > 1e-3
    assert linear_to_srgb(np.array([-1.0, 2.0])).tolist() == [0.0, 1.0]
