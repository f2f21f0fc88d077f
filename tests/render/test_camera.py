"""Cameras: the matrix and the rays are the same view."""

import numpy as np
import pytest

from prtbake_storage.contract.settings import Camera
from prtbake_storage.errors import SettingsError
from prtbake_workers.render.camera import camera_rays, depth_range, pinhole

BOUNDS = np.array([[-1.0, 0.0, -2.0], [3.0, 1.0, 2.0]])
WIDTH, HEIGHT = 13, 9


def projected(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    clip = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ matrix.T
    return clip[:, :3] / clip[:, 3:]


@pytest.mark.parametrize(
    "camera",
    [Camera(), Camera(eye=(4, 5, 6)), Camera(fov_deg=90, azimuth_deg=200, elevation_deg=-60)],
)
def test_points_along_rays_project_to_their_pixel_centres(camera: Camera) -> None:
    view = pinhole(camera, WIDTH, HEIGHT, BOUNDS)
    origins, directions = camera_rays(camera, WIDTH, HEIGHT, BOUNDS)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-15)
    found = projected(origins + 3.7 * directions, view.view_projection(0.1, 100.0))
    x = (np.arange(WIDTH) + 0.5) / WIDTH * 2 - 1
    y = 1 - (np.arange(HEIGHT) + 0.5) / HEIGHT * 2
    expected = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    # float64 throughout
    np.testing.assert_allclose(found[:, :2], expected, atol=1e-12)
    assert np.abs(found[:, :2] - expected[::-1]).max() > 0.1


@pytest.mark.parametrize("size", [(640, 480), (100, 400)])
@pytest.mark.parametrize("azimuth", [0.0, 30.0, 145.0])
def test_framing_holds_the_bounds_and_not_much_more(size: tuple[int, int], azimuth: float) -> None:
    view = pinhole(Camera(azimuth_deg=azimuth), *size, BOUNDS)
    near, far = depth_range(view, BOUNDS)
    corners = np.array([[BOUNDS[i >> k & 1, k] for k in range(3)] for i in range(8)])
    found = projected(corners, view.view_projection(near, far))
    assert np.abs(found).max() <= 1.0
    assert np.abs(found[:, :2]).max() > 0.85


def test_azimuth_runs_from_z_to_x_and_elevation_up() -> None:
    middle = BOUNDS.mean(axis=0)

    def looks_from(azimuth: float, elevation: float) -> np.ndarray:
        view = pinhole(Camera(azimuth_deg=azimuth, elevation_deg=elevation), 4, 3, BOUNDS)
        assert np.allclose(np.cross(view.eye - middle, view.back), 0)
        return view.back

    np.testing.assert_allclose(looks_from(0, 0), [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(looks_from(90, 0), [1, 0, 0], atol=1e-15)
    assert looks_from(0, 80)[1] > 0.98


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_framing_scales_with_the_scene(scale: float) -> None:
    view = pinhole(Camera(), 4, 3, BOUNDS * scale)
    unit = pinhole(Camera(), 4, 3, BOUNDS)
    np.testing.assert_allclose(view.eye, unit.eye * scale, rtol=1e-12)
    moved = unit.moved(np.array([1.0, 2.0, 3.0]), 0.5)
    np.testing.assert_allclose(moved.eye, (unit.eye - [1, 2, 3]) * 0.5)


def test_an_eye_inside_the_scene_still_has_a_near_plane() -> None:
    view = pinhole(Camera(eye=(0.0, 0.5, 0.0), target=(1.0, 0.5, 0.0)), 4, 3, BOUNDS)
    near, far = depth_range(view, BOUNDS)
    assert 0 < near < 1e-3 < 3.0 <= far


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (Camera(name="a", eye=(1, 1, 1), target=(1, 1, 1)), "'a': eye and target coincide"),
        (Camera(name="b", eye=(0, 5, 0), target=(0, 0, 0)), "'b': it looks along its own up"),
        (Camera(name="c", up=(0, 0, 0)), "'c': it looks along its own up"),
    ],
)
def test_cameras_that_see_nothing_are_refused_by_name(camera: Camera, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        pinhole(camera, 4, 3, BOUNDS)
