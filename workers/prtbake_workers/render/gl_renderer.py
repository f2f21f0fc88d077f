"""Render with OpenGL: a visibility buffer, then one shading pass a part.

The per-cluster work and the sum over weights are done on the CPU, only when the light changes; a
new view costs no CPU work at all.  Shading runs once a pixel, whatever the depth complexity.
"""

from dataclasses import dataclass
from importlib.resources import files
from itertools import pairwise
from typing import NamedTuple

import moderngl
import numpy as np

from prtbake_storage.decode.asset import Asset, Part
from prtbake_storage.decode.relight import relight
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.render.camera import Pinhole, depth_range
from prtbake_workers.render.context import GlUnavailable, check_error, create_context, describe
from prtbake_workers.render.picture import (
    Picture,
    Renderer,
    RendererInfo,
    Visibility,
    reduce_samples,
)
from prtbake_workers.render.targets import Target

MAX_TRIANGLES = (1 << 24) - 2
"""The visibility buffer counts triangles in float32."""

BINDINGS = {
    "faces": 0, "positions": 1, "normals": 2, "frames": 3, "radiance": 4, "uv": 5,
    "vertex_colours": 6,
}  # fmt: skip
VISIBILITY_UNIT, VIEW_UNIT, ALBEDO_UNIT = 0, 1, 2


@dataclass
class _PartObjects:
    """What lies on the device for one part."""

    frames: moderngl.Buffer
    radiance: moderngl.Buffer
    vertex_colours: moderngl.Buffer
    view_texture: moderngl.TextureArray | None
    albedo_texture: moderngl.Texture | None


class GlRenderer(Renderer):
    """Draws one asset in a context of its own; use it from the thread that made it.

    Parameters
    ----------
    asset
        What to draw.
    device_index
        EGL device; 0 is the first.
    reason
        Why this backend draws.

    Raises
    ------
    GlUnavailable
        No context, or buffers beyond the device's limits.
    """

    def __init__(self, asset: Asset, *, device_index: int = 0, reason: str = "asked for") -> None:
        self._asset = asset
        self._lit = False
        self._context = create_context(device_index)
        try:
            with self._context:
                device, version = describe(self._context)
                self._info = RendererInfo("egl", device, version, reason)
                self._upload()
                check_error(self._context, "uploading the asset")
        except BaseException:
            self.release()
            raise

    @property
    def info(self) -> RendererInfo:
        """What draws."""
        return self._info

    def set_light(self, light: Float64[F64, "coeffs 3"]) -> None:
        """Relight with whitened coefficients."""
        with self._context:
            for part, radiance in zip(self._parts, relight(self._asset, light), strict=True):
                part.radiance.write(np.ascontiguousarray(radiance))
            check_error(self._context, "setting the light")
        self._lit = True

    def visibility(self, view: Pinhole, width: int, height: int) -> Visibility:
        """Return the triangle behind every pixel centre."""
        with self._context:
            self._draw_visibility(view, width, height)
            seen = self._seen.read()
            check_error(self._context, "drawing visibility")
        triangles = (seen[:, :, 0] - 1.0).astype(np.int32)
        return Visibility(triangles, np.ascontiguousarray(seen[:, :, 1:]))

    def render(self, view: Pinhole, width: int, height: int, samples: int = 1) -> Picture:
        """Draw with ``samples`` x ``samples`` points a pixel."""
        if not self._lit:
            raise ValueError("set_light comes before render")
        columns, rows = width * samples, height * samples
        with self._context:
            self._draw_visibility(view, columns, rows)
            self._shade(view, columns, rows)
            pixels = self._colour.read()
            check_error(self._context, "shading")
        picture = Picture(np.ascontiguousarray(pixels[:, :, :3]), pixels[:, :, 3].copy())
        return reduce_samples(picture, samples)

    def release(self) -> None:
        """Give the context and all that lies in it back; a second call does nothing."""
        if not isinstance(self._context.mglo, moderngl.InvalidObject):
            self._context.release()
        self._lit = False

    def _upload(self) -> None:
        asset, context = self._asset, self._context
        if len(asset.faces) > MAX_TRIANGLES:
            raise GlUnavailable(f"{len(asset.faces)} triangles, at most {MAX_TRIANGLES}")
        lower = asset.positions.min(axis=0).astype(np.float64)
        upper = asset.positions.max(axis=0).astype(np.float64)
        # the device computes in float32: give it a scene of unit size about the origin
        self._centre = 0.5 * (lower + upper)
        self._scale = 1.0 / max(float(np.linalg.norm(upper - lower)), 1e-300)
        positions = ((asset.positions - self._centre) * self._scale).astype(np.float32)
        self._bounds = np.stack([positions.min(axis=0), positions.max(axis=0)]).astype(np.float64)
        self._mesh = {
            "faces": self._buffer("faces", asset.faces),
            "positions": self._buffer("positions", positions),
            "normals": self._buffer("normals", asset.normals),
            "uv": self._buffer("uv", np.zeros(2, np.float32) if asset.uv is None else asset.uv),
        }
        self._corners = context.buffer(np.ascontiguousarray(positions[asset.faces]))
        self._visibility_program = _program(context, "visibility", "visibility")
        self._triangles = context.vertex_array(
            self._visibility_program, [(self._corners, "3f4", "position")]
        )
        self._runs = _runs_of_sides(asset)
        self._shade_program = _program(context, "shade", "shade")
        self._screen = context.vertex_array(self._shade_program, [])
        self._seen = Target(context, depth=True)
        self._colour = Target(context, depth=False)
        self._parts = [self._upload_part(part) for part in asset.parts]

    def _upload_part(self, part: Part) -> _PartObjects:
        frames = np.zeros(9, np.float32) if part.frames is None else part.frames
        colours = np.zeros(3, np.float32) if part.vertex_colours is None else part.vertex_colours
        view_texture = albedo_texture = None
        if part.view_texture is not None:
            resolution, _, n_view, _ = part.view_texture.shape
            layers = np.broadcast_to(part.view_texture, (resolution, resolution, n_view, 3))
            data = np.ascontiguousarray(layers.transpose(2, 0, 1, 3))
            size = (resolution, resolution, n_view)
            view_texture = self._context.texture_array(size, 3, data, dtype="f4")
        if part.albedo_texture is not None:
            height, width, _ = part.albedo_texture.shape
            data = np.ascontiguousarray(part.albedo_texture)
            albedo_texture = self._context.texture((width, height), 3, data, dtype="f4")
        return _PartObjects(
            self._buffer("frames", frames),
            self._buffer("radiance", np.zeros((part.n_vertices, part.n_view, 3), np.float32)),
            self._buffer("vertex colours", colours),
            view_texture,
            albedo_texture,
        )

    def _buffer(self, name: str, array: np.ndarray) -> moderngl.Buffer:
        limit = self._context.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"]
        if array.nbytes > limit:
            raise GlUnavailable(f"{name} need {array.nbytes} bytes, the device allows {limit}")
        return self._context.buffer(np.ascontiguousarray(array))

    def _draw_visibility(self, view: Pinhole, width: int, height: int) -> None:
        self._seen.begin(width, height)
        moved = view.moved(self._centre, self._scale)
        matrix = moved.view_projection(*depth_range(moved, self._bounds))
        columns = tuple(float(x) for x in matrix.T.reshape(-1))
        self._visibility_program["view_projection"] = columns
        for run in self._runs:
            culling = moderngl.CULL_FACE if run.two_sided else moderngl.NOTHING
            self._context.enable_only(moderngl.DEPTH_TEST | culling)
            self._visibility_program["first_triangle"] = run.start
            self._triangles.render(
                moderngl.TRIANGLES, vertices=3 * (run.stop - run.start), first=3 * run.start
            )

    def _shade(self, view: Pinhole, width: int, height: int) -> None:
        self._colour.begin(width, height)
        self._context.enable_only(moderngl.NOTHING)
        if self._seen.colour is not None:
            self._seen.colour.use(VISIBILITY_UNIT)
        for name, buffer in self._mesh.items():
            buffer.bind_to_storage_buffer(BINDINGS[name])
        uniforms: dict[str, object] = {
            "visibility": VISIBILITY_UNIT,
            "view_texture": VIEW_UNIT,
            "albedo_texture": ALBEDO_UNIT,
            "camera_right": tuple(view.right),
            "camera_up": tuple(view.up),
            "camera_back": tuple(view.back),
            "half_extent": (view.tan_x, view.tan_y),
            "size": (width, height),
        }
        for part, objects in zip(self._asset.parts, self._parts, strict=True):
            objects.frames.bind_to_storage_buffer(BINDINGS["frames"])
            objects.radiance.bind_to_storage_buffer(BINDINGS["radiance"])
            objects.vertex_colours.bind_to_storage_buffer(BINDINGS["vertex_colours"])
            if objects.view_texture is not None:
                objects.view_texture.use(VIEW_UNIT)
            if objects.albedo_texture is not None:
                objects.albedo_texture.use(ALBEDO_UNIT)
            uniforms |= {
                "part_range": part.vertex_range,
                "n_view": part.n_view,
                "has_view_texture": objects.view_texture is not None,
                "has_albedo_texture": objects.albedo_texture is not None,
                "has_vertex_colours": part.vertex_colours is not None,
                "albedo": tuple(float(x) for x in np.broadcast_to(part.albedo, 3)),
            }
            for name, value in uniforms.items():
                self._shade_program[name] = value
            self._screen.render(moderngl.TRIANGLES, vertices=3)


class _Run(NamedTuple):
    """Triangles start..stop, of which two copies face opposite sides, or one both."""

    start: int
    stop: int
    two_sided: bool


def _runs_of_sides(asset: Asset) -> list[_Run]:
    """Cut the triangles where parts with one side and with two follow each other."""
    if asset.opposite is None:
        return [_Run(0, len(asset.faces), False)]
    both = asset.opposite >= 0
    edges = [0, *(np.flatnonzero(both[1:] != both[:-1]) + 1).tolist(), len(both)]
    return [_Run(start, stop, bool(both[start])) for start, stop in pairwise(edges)]


def _program(context: moderngl.Context, vertex: str, fragment: str) -> moderngl.Program:
    folder = files("prtbake_workers.render") / "programs"
    return context.program(
        vertex_shader=(folder / f"{vertex}.vert").read_text("utf-8"),
        fragment_shader=(folder / f"{fragment}.frag").read_text("utf-8"),
    )
