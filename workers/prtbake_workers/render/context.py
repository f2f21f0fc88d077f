"""An OpenGL context without a window, through EGL, and how to tell that there is none.

A context belongs to the thread that made it.  A forked child of a process that ever had one hangs:
renderers live in a process of their own, started by spawn or exec.

Leave ``gc_mode`` of a context alone: with automatic collection an object that dies late is deleted
by its name in whatever context is current by then, and takes that context's object with it.
"""

import json
import subprocess
import sys
from functools import cache
from typing import Any

import moderngl

from prtbake_storage.errors import PrtError

REQUIRED_VERSION = 430
"""GLSL 4.30 has the storage buffers that the shading reads."""

LIBGL, LIBEGL = "libGL.so.1", "libEGL.so.1"
"""The run-time names: the library's own search falls back to names of development packages."""

PACKAGES = "libegl1 libgl1"
"""What Debian and its kin call them."""

PROBE_SECONDS = 60.0


class GlUnavailable(PrtError):
    """No OpenGL context can be made here, or it cannot hold the asset."""

    code = "gl-unavailable"
    kind = "resource"


def create_context(device_index: int = 0) -> moderngl.Context:
    """Make an EGL context with OpenGL 4.3 in this thread.

    Raises
    ------
    GlUnavailable
        With the library's own words, and the packages that are usually missing.
    """
    settings: dict[str, Any] = {
        "backend": "egl",
        "libgl": LIBGL,
        "libegl": LIBEGL,
        "device_index": device_index,
    }
    try:
        context = moderngl.create_context(require=REQUIRED_VERSION, standalone=True, **settings)
    except Exception as error:  # the library raises bare Exceptions
        raise GlUnavailable(f"no EGL context ({error}); packages needed: {PACKAGES}") from error
    return context


def describe(context: moderngl.Context) -> tuple[str, str]:
    """Name the device and the version of a context."""
    info: dict[str, Any] = context.info
    return str(info["GL_RENDERER"]), str(info["GL_VERSION"])


def check_error(context: moderngl.Context, doing: str) -> None:
    """Raise where OpenGL has recorded an error: it tells in no other way."""
    error = context.error
    if error != "GL_NO_ERROR":
        raise GlUnavailable(f"{error} while {doing}")


@cache
def _probe() -> tuple[bool, str]:
    """Tell whether a context can be made, and the device or the reason."""
    command = [sys.executable, "-m", "prtbake_workers.render.context"]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=PROBE_SECONDS, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return False, f"the EGL probe did not end: {error}"
    if done.returncode != 0 or not done.stdout.strip():
        return False, f"the EGL probe died with status {done.returncode}"
    answer = json.loads(done.stdout.splitlines()[-1])
    return bool(answer["works"]), str(answer["detail"])


def probe() -> str:
    """Try a context in a process that may die of it; tried once, remembered.

    Returns
    -------
    str
        The device.

    Raises
    ------
    GlUnavailable
        With the reason.
    """
    works, detail = _probe()
    if not works:
        raise GlUnavailable(detail)
    return detail


def main() -> int:
    """Report as JSON whether a context can be made: the body of `probe`."""
    try:
        context = create_context()
        answer = {"works": True, "detail": " ".join(describe(context))}
        context.release()
    except GlUnavailable as error:
        answer = {"works": False, "detail": error.detail}
    sys.stdout.write(json.dumps(answer) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
