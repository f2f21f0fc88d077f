"""Layouts: recognised or refused, and the directions their pixels show."""

import numpy as np
import pytest

from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.environment.layouts import layout_of, recognise_layout
from prtbake_workers.environment.picture import Picture


def picture(height: int, width: int, value: float = 1.0, attribute: str | None = None) -> Picture:
    pixels = np.full((height, width, 3), value, dtype=np.float32)
    return Picture(pixels, "exr", "float32", ("R", "G", "B"), layout_attribute=attribute)


def black_rim(size: int) -> Picture:
    result = picture(size, size)
    offset = (np.arange(size) + 0.5) * 2 / size - 1
    result.pixels[np.hypot(offset[:, None], offset) > 1] = 0
    return result


def test_layouts_are_recognised_by_attribute_and_shape() -> None:
    assert recognise_layout(picture(8, 16), None)[0] == "lat_long"
    assert recognise_layout(picture(48, 8), None)[0] == "cube_strip"
    assert recognise_layout(picture(8, 16, attribute="lat_long_exr"), None)[0] == "lat_long_exr"
    assert recognise_layout(black_rim(32), "scans/grace_PROBE.hdr")[0] == "angular_probe"


@pytest.mark.parametrize(
    ("it", "name"),
    [(black_rim(32), "ball.exr"), (black_rim(32), None), (picture(32, 32), "a_probe.hdr")],
)
def test_a_square_is_not_guessed(it, name) -> None:
    with pytest.raises(EnvironmentMapError, match="state the layout") as caught:
        recognise_layout(it, name)
    assert caught.value.pointer == "/layout"


def test_other_shapes_are_refused() -> None:
    with pytest.raises(EnvironmentMapError, match="32 x 24"):
        recognise_layout(picture(24, 32), None)
    with pytest.raises(EnvironmentMapError, match="angular_probe needs a picture of 1:1"):
        layout_of("angular_probe", 16, 32)


@pytest.mark.parametrize(
    ("name", "height", "width", "tolerance"),
    # exact cells; the probe's pixels at the rim are cut by the disc
    [
        ("lat_long", 16, 32, 1e-12),
        ("lat_long_exr", 16, 32, 1e-12),
        ("cube_strip", 96, 16, 1e-12),
        ("angular_probe", 200, 200, 2e-3),
    ],
)
def test_pixels_cover_the_sphere_once(name, height, width, tolerance) -> None:
    total = layout_of(name, height, width).solid_angles.sum()
    assert total == pytest.approx(4 * np.pi, rel=tolerance)


@pytest.mark.parametrize(
    ("name", "height", "width"), [("cube_strip", 96, 16), ("angular_probe", 64, 64)]
)
def test_solid_angles_are_those_of_the_directions_that_fall_in(name, height, width, rng) -> None:
    layout = layout_of(name, height, width)
    n = 400_000
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    share = np.bincount(layout.pixel_of(directions), minlength=height * width) / n

    def chi_square(expected):
        seen = expected * n > 5
        return ((share - expected)[seen] ** 2 / expected[seen]).sum() * n / seen.sum()

    expected = layout.solid_angles / layout.solid_angles.sum()
    # mean 1 and a spread of sqrt(2 / 1500) = 0.04 for cells without systematic error; the probe's
    # one-point rule adds a little
    assert chi_square(expected) < 1.25
    assert chi_square(np.full(height * width, 1 / (height * width))) > 2


@pytest.mark.parametrize(
    ("direction", "face", "right", "down"),
    # ImfEnvmap: on face +x the picture's right is +z and its bottom -y, and so on
    [
        ((1, -0.5, 0.9), 0, 0.9, 0.5),
        ((-1, -0.5, 0.9), 1, -0.9, 0.5),
        ((0.9, 1, -0.5), 2, 0.9, 0.5),
        ((0.9, -1, 0.5), 3, 0.9, 0.5),
        ((-0.9, -0.5, 1), 4, 0.9, 0.5),
        ((0.9, -0.5, -1), 5, 0.9, 0.5),
    ],
)
def test_cube_faces_are_placed_as_openexr_says(direction, face, right, down) -> None:
    size = 101
    d = np.array([direction]) / np.linalg.norm(direction)
    pixel = int(layout_of("cube_strip", 6 * size, size).pixel_of(d)[0])
    row, column = divmod(pixel, size)
    assert row // size == face
    assert column == round((right + 1) / 2 * (size - 1))
    assert row % size == round((down + 1) / 2 * (size - 1))


@pytest.mark.parametrize(
    ("direction", "column", "row"),
    [((0, 0, -1), 50, 50), ((1, 0, 0), 75, 50), ((0, 1, 0), 50, 25), ((0, 0, 1), None, None)],
)
def test_an_angular_probe_looks_along_minus_z(direction, column, row) -> None:
    pixel = int(layout_of("angular_probe", 101, 101).pixel_of(np.array([direction], float))[0])
    assert 0 <= pixel < 101 * 101
    if column is not None:
        assert divmod(pixel, 101) == (row, column)
