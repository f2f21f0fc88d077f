"""Choose a renderer: OpenGL where it works, else the CPU, and say which and why."""

import logging

from prtbake_storage.decode.asset import Asset
from prtbake_storage.errors import SettingsError
from prtbake_workers.render.context import GlUnavailable, probe
from prtbake_workers.render.cpu_renderer import CpuRenderer, Intersector
from prtbake_workers.render.gl_renderer import GlRenderer
from prtbake_workers.render.picture import Renderer

logger = logging.getLogger(__name__)


def open_renderer(
    asset: Asset, backend: str = "auto", *, intersector: Intersector | None = None
) -> Renderer:
    """Open a renderer for an asset; it is a context manager.

    Parameters
    ----------
    asset
        What to draw.
    backend
        ``egl``, ``cpu``, or ``auto``: EGL if a trial in another process gives a context and the
        asset fits it, else the CPU, with the reason in ``info.reason``.
    intersector
        Primary rays for the CPU; Embree by default.

    Raises
    ------
    SettingsError
        ``egl`` was asked for and there is none, or the backend is unknown.
    """
    if backend not in ("auto", "egl", "cpu"):
        raise SettingsError(f"backend {backend!r} is not auto, egl or cpu", pointer="/backend")
    renderer: Renderer
    if backend == "cpu":
        renderer = CpuRenderer(asset, intersector)
    else:
        chosen = "asked for" if backend == "egl" else "EGL works here"
        try:
            probe()
            renderer = GlRenderer(asset, reason=chosen)
        except GlUnavailable as error:
            if backend == "egl":
                raise SettingsError(f"backend egl: {error.detail}", pointer="/backend") from error
            renderer = CpuRenderer(asset, intersector, reason=error.detail)
    info = renderer.info
    logger.info(
        "render.opened",
        extra={"backend": info.backend, "device": info.device, "reason": info.reason},
    )
    return renderer
