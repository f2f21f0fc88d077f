"""From bytes to distant light, and what the report says."""

import json

import numpy as np
import OpenEXR
import pytest

from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.environment import reading
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.reading import read_environment


def soft_light(directions):
    """A light that varies slowly and differently along every axis."""
    x, y, z = directions.T
    return np.stack([2 + x, 2 + y, 2 + z + 0.3 * x * y], axis=1)


def cube_pixels(size: int):
    """``soft_light`` on the six faces, from ImfEnvmap's corners: right and down of each face."""
    t = np.linspace(-1, 1, size)
    right, down = np.meshgrid(t, t)
    one = np.ones_like(right)
    faces = [
        (one, -down, right), (-one, -down, -right), (right, one, -down),
        (right, -one, down), (-right, -down, one), (right, -down, -one),
    ]  # fmt: skip
    directions = np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in faces])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return soft_light(directions).reshape(6 * size, size, 3).astype(np.float32)


def probe_pixels(size: int):
    """``soft_light`` in an angular probe; garbage outside the disc."""
    t = (np.arange(size) + 0.5) * 2 / size - 1
    u, v = np.meshgrid(t, -t)
    radius = np.hypot(u, v)
    sine = np.sin(np.pi * radius) / radius
    directions = np.stack([u * sine, v * sine, -np.cos(np.pi * radius)], axis=-1)
    pixels = soft_light(directions.reshape(-1, 3)).reshape(size, size, 3)
    pixels[radius > 1 + 2 / size] = 1e4
    return pixels.astype(np.float32)


def exr_channels(pixels):
    return {c: np.ascontiguousarray(pixels[:, :, i]) for i, c in enumerate("RGB")}


def relative_error(environment: Environment) -> float:
    wanted = soft_light(environment.directions())
    found = environment.radiance.reshape(-1, 3)
    weights = environment.solid_angles()
    return float(np.sqrt((weights @ (found - wanted) ** 2).sum() / (weights @ wanted**2).sum()))


@pytest.mark.parametrize(
    ("name", "pixels"), [("cube_strip", cube_pixels(32)), ("angular_probe", probe_pixels(128))]
)
def test_other_layouts_show_the_same_light(make_exr, name, pixels) -> None:
    data = make_exr(exr_channels(pixels))
    environment, report = read_environment(data, layout=name)
    # a pixel is 0.05 wide and the light's slope about a half of its value: 0.05 / sqrt(12) / 2
    assert relative_error(environment) < 0.015
    assert report.resampled
    assert report.layout_from == "stated"
    assert report.energy_ratio == pytest.approx(1.0, abs=5e-3)
    mirrored = Environment(np.ascontiguousarray(environment.radiance[:, ::-1]))
    assert relative_error(mirrored) > 0.1


def test_openexr_lat_long_is_turned_by_half(make_exr) -> None:
    width = 64
    longitude = np.pi - 2 * np.pi * np.arange(width) / (width - 1)
    latitude_nodes = np.pi / 2 - np.pi * np.arange(32) / 31
    directions = np.stack(
        [
            np.sin(longitude) * np.cos(latitude_nodes)[:, None],
            np.broadcast_to(np.sin(latitude_nodes)[:, None], (32, width)),
            np.cos(longitude) * np.cos(latitude_nodes)[:, None],
        ],
        axis=-1,
    )
    pixels = soft_light(directions.reshape(-1, 3)).reshape(32, width, 3).astype(np.float32)
    data = make_exr(exr_channels(pixels), envmap=OpenEXR.ENVMAP_LATLONG)
    environment, report = read_environment(data)
    assert report.layout == "lat_long_exr"
    # half a texel at 64 around the sphere: 0.05 / 2 / sqrt(3) / 2
    assert relative_error(environment) < 0.01
    plain, _ = read_environment(make_exr(exr_channels(pixels)))
    assert relative_error(plain) > 0.1


def test_a_lat_long_map_is_kept_as_it_is(make_hdr, smooth_picture) -> None:
    environment, report = read_environment(make_hdr(smooth_picture))
    assert np.array_equal(environment.radiance, smooth_picture)
    assert (report.layout, report.resampled, report.energy_ratio) == ("lat_long", False, 1.0)
    assert json.loads(json.dumps(report.to_dict()))["layout_from"] == "the aspect ratio 2:1"


def test_a_wide_map_is_box_filtered(make_exr, smooth_picture, monkeypatch) -> None:
    monkeypatch.setattr(reading, "MAX_WIDTH", 32)
    environment, report = read_environment(make_exr(exr_channels(smooth_picture)))
    assert (environment.width, environment.height) == (32, 16)
    assert report.resampled
    assert environment.mean_radiance == pytest.approx(
        Environment(smooth_picture).mean_radiance, rel=1e-6
    )


def test_rotation_is_applied_and_reported(make_hdr, smooth_picture) -> None:
    quarter, report = read_environment(make_hdr(smooth_picture), rotation_deg=(0.0, 90.0, 0.0))
    assert report.rotation_deg == (0.0, 90.0, 0.0)
    # R turns z to x, so what stood at x (u 0.75) now stands at -z (u 0.5): a shift by 16 columns
    assert np.allclose(quarter.radiance, np.roll(smooth_picture, -16, axis=1), rtol=1e-6)


def test_a_statement_against_the_attribute_wins_and_is_reported(make_exr, smooth_picture) -> None:
    data = make_exr(exr_channels(smooth_picture), envmap=OpenEXR.ENVMAP_LATLONG)
    environment, report = read_environment(data, layout="lat_long")
    assert np.array_equal(environment.radiance, smooth_picture)
    assert "against the file's attribute (lat_long_exr)" in report.layout_from


@pytest.mark.parametrize(
    ("data", "message"),
    [(b"", "empty"), (b"\x89PNG\r\n", "neither"), (b"#?RADIANCE\n", "no resolution line")],
)
def test_what_is_no_hdr_picture_is_refused(data, message) -> None:
    with pytest.raises(EnvironmentMapError, match=message):
        read_environment(data)


def test_an_unknown_layout_is_refused(make_hdr, smooth_picture) -> None:
    with pytest.raises(EnvironmentMapError, match="mirror_ball") as caught:
        read_environment(make_hdr(smooth_picture), layout="mirror_ball")
    assert caught.value.pointer == "/layout"
