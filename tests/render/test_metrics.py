"""Metrics against closed forms."""

import json

import numpy as np
import pytest

from prtbake_workers.render.metrics import compare, flip, psnr, rel_mse, relative_l2

ALL = np.ones((20, 24), np.bool_)


@pytest.fixture
def reference(rng: np.random.Generator) -> np.ndarray:
    return (0.5 + rng.random((20, 24, 3))).astype(np.float32)


def test_ten_per_cent_brighter_is_ten_per_cent(reference: np.ndarray) -> None:
    test = (reference * np.float32(1.1)).astype(np.float32)
    # float32 rounding of the picture itself
    assert relative_l2(test, reference, ALL) == pytest.approx(0.1, rel=1e-5)
    square = reference.astype(np.float64) ** 2
    expected = (0.01 * square / (square + 0.01 * square.mean())).mean()
    assert rel_mse(test, reference, ALL) == pytest.approx(expected, rel=1e-5)
    assert relative_l2(reference, test, ALL) != pytest.approx(0.1, rel=1e-2)


def test_psnr_of_one_code_everywhere() -> None:
    codes = np.full((20, 24, 3), 100.0)
    linear = ((codes / 255 + 0.055) / 1.055) ** 2.4
    above = (((codes + 1) / 255 + 0.055) / 1.055) ** 2.4
    found = psnr(above.astype(np.float32), linear.astype(np.float32), ALL, 1.0)
    assert found == pytest.approx(20 * np.log10(255), rel=1e-9)


def test_only_the_mask_counts(reference: np.ndarray) -> None:
    mask = ALL.copy()
    mask[:, :12] = False
    test = reference.copy()
    test[:, :12] *= 5
    found = compare(test, reference, mask, 1.0).to_dict()
    assert found == {
        "relative_l2": 0.0, "rel_mse": 0.0, "psnr_db": None, "flip": 0.0, "max_abs": 0.0,
        "pixels": 240, "black_reference": False,
    }  # fmt: skip
    assert relative_l2(test, reference, ALL) > 1.0


def test_flip_grows_with_the_error(reference: np.ndarray) -> None:
    errors = [flip((reference * f).astype(np.float32), reference, ALL)[0] for f in (1, 1.02, 1.5)]
    assert errors[0] == 0.0
    assert 0.0 < errors[1] < errors[2] < 1.0
    mean, image = flip((reference * 1.5).astype(np.float32), reference, ALL)
    assert image.shape == ALL.shape
    assert mean == pytest.approx(float(image.mean()), rel=1e-5)


def test_black_pictures_have_figures_too(reference: np.ndarray) -> None:
    black = np.zeros_like(reference)
    same = compare(black, black, ALL, 1.0)
    assert (same.relative_l2, same.rel_mse, same.flip, same.psnr_db) == (0.0, 0.0, 0.0, None)
    wrong = compare(reference, black, ALL, 1.0)
    assert (wrong.relative_l2, wrong.rel_mse, wrong.flip) == (None, None, 1.0)
    assert (same.black_reference, wrong.black_reference) == (True, True)
    assert wrong.max_abs == pytest.approx(float(reference.max()), rel=1e-6)
    json.dumps(wrong.to_dict(), allow_nan=False)
    # one texel that is not black is something to be relative to
    speck = black.copy()
    speck[3, 4, 1] = 1e-3
    assert compare(reference, speck, ALL, 1.0).relative_l2 is not None
    nothing = compare(reference, black, ~ALL, 1.0)
    assert (nothing.relative_l2, nothing.flip, nothing.pixels) == (0.0, 0.0, 0)
    assert not nothing.black_reference
