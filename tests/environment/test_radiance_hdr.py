"""Radiance pictures: encodings, orientations, exposure, damage."""

import numpy as np
import pytest

from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.environment.radiance_hdr import decode_radiance_hdr


def test_flat_pixels_come_back_exactly(make_hdr, smooth_picture) -> None:
    picture = decode_radiance_hdr(make_hdr(smooth_picture))
    assert np.array_equal(picture.pixels, smooth_picture)
    assert picture.pixel_type == "rgbe"


@pytest.mark.parametrize(
    ("resolution", "turn"),
    [
        (b"-Y 32 +X 64", lambda p: p),
        (b"+Y 32 +X 64", lambda p: p[::-1]),
        (b"-Y 32 -X 64", lambda p: p[:, ::-1]),
        (b"+Y 32 -X 64", lambda p: p[::-1, ::-1]),
        (b"+X 64 -Y 32", lambda p: p.transpose(1, 0, 2)),
        (b"-X 64 -Y 32", lambda p: p[:, ::-1].transpose(1, 0, 2)),
        (b"+X 64 +Y 32", lambda p: p[::-1].transpose(1, 0, 2)),
        (b"-X 64 +Y 32", lambda p: p[::-1, ::-1].transpose(1, 0, 2)),
    ],
)
def test_all_eight_orientations_give_the_same_picture(
    make_hdr, smooth_picture, resolution, turn
) -> None:
    stored = np.ascontiguousarray(turn(smooth_picture))
    picture = decode_radiance_hdr(make_hdr(stored, resolution=resolution))
    assert np.array_equal(picture.pixels, smooth_picture)


def test_new_run_lengths_are_decoded(make_hdr) -> None:
    header = make_hdr(np.ones((1, 16, 3), np.float32))[:-64]
    # components R, G, B, E of one scanline: runs of 16, then 10 + 6 values, a run, a run
    line = bytes(
        [
            2,
            2,
            0,
            16,
            128 + 16,
            128,
            128 + 10,
            128,
            6,
            *range(130, 136),
            128 + 16,
            64,
            128 + 16,
            129,
        ]
    )
    pixels = decode_radiance_hdr(header + line).pixels
    assert (pixels[0, :, 0] == 1.0).all()
    assert (pixels[0, :10, 1] == 1.0).all()
    assert np.array_equal(pixels[0, 10:, 1], np.arange(130, 136) / 128)
    assert (pixels[0, :, 2] == 0.5).all()


def test_old_run_lengths_are_decoded_with_long_counts(make_hdr) -> None:
    first, second = [128, 64, 32, 129], [200, 100, 50, 130]
    header = make_hdr(np.ones((32, 64, 3), np.float32))[: -32 * 64 * 4]
    # the first pixel, repeated 0x2 + 0x3 * 256 = 770 times more; the second to the end: 1277
    codes = [first, [1, 1, 1, 2], [1, 1, 1, 3], second, [1, 1, 1, 0xFC], [1, 1, 1, 4]]
    pixels = decode_radiance_hdr(header + bytes(np.ravel(codes).tolist())).pixels.reshape(-1, 3)
    assert (pixels[:771] == np.array([1.0, 0.5, 0.25])).all()
    assert (pixels[771:] == np.array(second[:3]) / 256 * 4).all()


def test_exposure_and_colour_correction_are_divided_out(make_hdr, smooth_picture) -> None:
    header = b"EXPOSURE=2\nEXPOSURE= 4.0\nCOLORCORR=1 2 0.5\n"
    picture = decode_radiance_hdr(make_hdr(smooth_picture, header))
    assert np.array_equal(picture.pixels, smooth_picture / np.array([8, 16, 4], np.float32))
    assert picture.facts == {"exposure_divided": [8.0, 16.0, 4.0]}


def test_primaries_of_zeros_are_nothing_to_warn_of(make_hdr, smooth_picture) -> None:
    zeros = decode_radiance_hdr(make_hdr(smooth_picture, b"PRIMARIES=0 0 0 0 0 0 0 0\nGAMMA=1\n"))
    assert not zeros.warnings
    wide = decode_radiance_hdr(
        make_hdr(smooth_picture, b"PRIMARIES=0.7 0.3 0.2 0.7 0.1 0.1 0.3 0.3\n")
    )
    assert "Rec.709" in wide.warnings[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.replace(b"rle_rgbe", b"rle_xyze"), "32-bit_rle_xyze"),
        (lambda d: d.replace(b"-Y 32", b"-Y 0"), "nothing to read"),
        (lambda d: d.replace(b"-Y 32", b"-Y 999999"), "at most"),
        (lambda d: d.replace(b"-Y 32", b"-X 32"), "resolution line"),
        (lambda d: d[:-400], "the pixels end early"),
        (lambda d: d[:30], "no resolution line"),
        (lambda d: d.replace(b"FORMAT", b"EXPOSURE=0\nFORMAT"), "positive"),
        (lambda d: d.replace(b"FORMAT", b"GAMMA=2.2\nFORMAT"), "gamma 1"),
    ],
)
def test_what_is_not_understood_is_refused(make_hdr, smooth_picture, change, message) -> None:
    with pytest.raises(EnvironmentMapError, match=message):
        decode_radiance_hdr(change(make_hdr(smooth_picture)))


def test_damaged_run_lengths_are_refused(make_hdr) -> None:
    header = make_hdr(np.ones((1, 16, 3), np.float32))[:-64]
    with pytest.raises(EnvironmentMapError, match="damaged"):
        decode_radiance_hdr(header + bytes([2, 2, 0, 16, 255, 1, 255, 1]))
