"""Float render targets that are kept from picture to picture."""

import moderngl
import numpy as np

from prtbake_workers.arrays import F32


class Target:
    """A float32 RGBA texture to draw into, with depth where asked for.

    OpenGL must not lose the framebuffer that is bound: creating anything rebinds it and fails.  So
    a target lives on until one of another size has taken its place.
    """

    def __init__(self, context: moderngl.Context, *, depth: bool) -> None:
        self._context = context
        self._with_depth = depth
        self._depth: moderngl.Renderbuffer | None = None
        self._framebuffer: moderngl.Framebuffer | None = None
        self.colour: moderngl.Texture | None = None

    def begin(self, width: int, height: int) -> None:
        """Bind the target at a size, cleared to zero and to the far plane."""
        if self.colour is None or self.colour.size != (width, height):
            old = (self._framebuffer, self.colour, self._depth)
            self.colour = self._context.texture((width, height), 4, dtype="f4")
            if self._with_depth:
                self._depth = self._context.depth_renderbuffer((width, height))
            self._framebuffer = self._context.framebuffer([self.colour], self._depth)
            self._framebuffer.use()
            for item in old:
                if item is not None:
                    item.release()
        if self._framebuffer is not None:
            self._framebuffer.use()
            self._framebuffer.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)

    def read(self) -> F32:
        """Return (height, width, 4), upper row first."""
        if self._framebuffer is None:
            raise ValueError("begin comes before read")
        width, height = self._framebuffer.size
        # without dtype the library would clamp to bytes
        data = self._framebuffer.read(components=4, dtype="f4", alignment=1)
        return np.frombuffer(data, np.float32).reshape(height, width, 4)[::-1]
