"""Choosing a backend, and the CPU one where there is no OpenGL."""

import logging
from collections.abc import Iterator

import numpy as np
import pytest

from prtbake_storage.contract.settings import Camera
from prtbake_storage.decode.asset import Asset
from prtbake_storage.errors import SettingsError
from prtbake_workers.render import context
from prtbake_workers.render.camera import Pinhole, pinhole
from prtbake_workers.render.cpu_renderer import CpuRenderer
from prtbake_workers.render.renderer import open_renderer

WIDTH, HEIGHT = 60, 45


def view_of(asset: Asset) -> Pinhole:
    bounds = np.stack([asset.positions.min(axis=0), asset.positions.max(axis=0)])
    return pinhole(Camera(), WIDTH, HEIGHT, bounds.astype(np.float64))


@pytest.fixture
def no_egl(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A machine whose EGL knows no vendor, as in a container without drivers."""
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent/vendor.json")
    context._probe.cache_clear()
    yield
    context._probe.cache_clear()


@pytest.mark.usefixtures("no_egl")
def test_without_egl_the_cpu_draws_and_says_why(
    scene: Asset, light: np.ndarray, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO), open_renderer(scene, "auto") as renderer:
        assert renderer.info.backend == "cpu"
        assert "libegl1 libgl1" in renderer.info.reason
        renderer.set_light(light)
        picture = renderer.render(view_of(scene), WIDTH, HEIGHT)
    assert caplog.records[-1].__dict__["backend"] == "cpu"
    with CpuRenderer(scene) as plain:
        plain.set_light(light)
        expected = plain.render(view_of(scene), WIDTH, HEIGHT)
    np.testing.assert_array_equal(picture.radiance, expected.radiance)
    with pytest.raises(SettingsError, match="libegl1 libgl1"):
        open_renderer(scene, "egl")


@pytest.mark.gl
@pytest.mark.parametrize("backend", ["auto", "egl"])
def test_with_egl_it_draws(scene: Asset, backend: str) -> None:
    with open_renderer(scene, backend) as renderer:
        assert renderer.info.backend == "egl"
        assert renderer.info.device in context.probe()


def test_an_unknown_backend_is_refused(scene: Asset) -> None:
    with pytest.raises(SettingsError, match="vulkan"):
        open_renderer(scene, "vulkan")


def test_another_intersector_may_serve(scene: Asset, light: np.ndarray) -> None:
    def nothing(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        n = len(directions)
        return np.full(n, -1, np.int32), np.zeros((n, 3), np.float32)

    with open_renderer(scene, "cpu", intersector=nothing) as renderer:
        renderer.set_light(light)
        picture = renderer.render(view_of(scene), WIDTH, HEIGHT)
    assert not picture.coverage.any()
    assert not picture.radiance.any()
