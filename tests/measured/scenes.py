"""The scenes of the measured results, as they are typed on the command line."""

import shlex
from dataclasses import dataclass

DATA = "$PRTBAKE_DATA"
"""Stands for the folder of the real data, in what runs and in what is written of it."""

LIGHT = ("--environment", f"{DATA}/environments/kloppenheim_05_1k.hdr")
SIZE = ("--set", "render.width=480", "--set", "render.height=360")
MEDIUM = ("--quality", "medium", "--receiver", "96", *SIZE)
LOW = ("--quality", "low", "--receiver", "64", *SIZE)
QUICK = (
    "--quality", "draft", "--receiver", "12", *SIZE,
    "--set", "validation.width=64", "--set", "validation.height=48",
    "--set", "validation.passes=2", "--set", "validation.samples=16",
)  # fmt: skip
"""Coarse enough to try the command: nothing that comes of it is a result."""

MARBLE = '{"brdf": {"model": "lambert"}, "subsurface": {"medium": "marble", "mm_per_unit": 20}}'
N_CLUSTERS = 97
MAX_ITERATIONS = 8
RANK_PAIRS = {
    (8, 48, 24): "15.89 MB",
    (8, 24, 24): "9.40 MB",
    (8, 48, 12): "13.00 MB",
    (8, 24, 12): "7.26 MB",
}
"""Ranks of view, light and vertices, and the bytes that [Tsai2006] figure 5 states for them."""


@dataclass(frozen=True)
class Scene:
    """An asset job: ``options`` always, ``settings`` beside those of the quality in full.

    ``full`` says what that quality is.
    """

    name: str
    title: str
    about: str
    options: tuple[str, ...]
    settings: tuple[str, ...] = ()
    rank_pairs: bool = False
    full: tuple[str, ...] = MEDIUM

    def arguments(self, *, quick: bool) -> list[str]:
        """Return what follows ``prtbake submit asset``, with `DATA` for the folder."""
        return [*self.options, *LIGHT, *(QUICK if quick else (*self.full, *self.settings))]

    def command(self, *, quick: bool) -> str:
        """Return the command as it is typed, an option a line."""
        words = self.arguments(quick=quick)
        lines = [
            # what the shell is to fill in stays open to it
            f"{option} {value if value.startswith(DATA) else shlex.quote(value)}"
            for option, value in zip(words[::2], words[1::2], strict=True)
        ]
        return " \\\n    ".join(["prtbake submit asset", *lines])


SCENES = (
    Scene(
        name="bunny",
        title="Bunny on a plane, Cook-Torrance",
        about="The Stanford bunny on a diffuse plane under a field with a high sun, at the "
        "settings of Tsai and Shih's table 1.",
        options=(
            "--mesh", f"{DATA}/meshes/stanford-bunny.obj",
            "--brdf", "cook_torrance,m=0.5,kd=0.3,ks=0.7,f0=0.1",
        ),
        settings=(
            "--set", "bake.n_terms=16", "--set", "compress.ranks=8,48,24",
            "--set", f"compress.n_clusters={N_CLUSTERS}",
        ),
        rank_pairs=True,
    ),
    Scene(
        name="spot",
        title="Spot on a plane, diffuse, textured",
        about="Spot with its texture as albedo on a diffuse plane, under the bunny's light.",
        options=(
            "--mesh", f"{DATA}/meshes/spot/spot_triangulated.obj",
            "--albedo-texture", f"{DATA}/meshes/spot/spot_texture.png",
            "--brdf", "lambert",
        ),
    ),
    Scene(
        name="shaderball",
        title="Shaderball in two materials, every effect",
        about="The shaderball with a brushed shell, whose grain follows the texture coordinates, "
        "around a ball and foot of marble that scatters light inside, on a textured plane: three "
        "bounces, colours of their own. Planning takes every effect by itself.",
        options=(
            "--mesh", f"{DATA}/meshes/gltf/shaderball.glb",
            "--brdf", "ward,kd=0.25:0.12:0.05,ks=0.4,alpha_x=0.25,alpha_y=0.6",
            "--tangents", "uv",
            "--material", f"Calibration_Mesh={MARBLE}",
            "--receiver-texture", f"{DATA}/meshes/spot/spot_texture.png",
        ),
        settings=(
            "--set", "bake.n_terms=16", "--set", "bake.max_bounces=3",
            "--set", "bake.bounce_tolerance=1e-5", "--set", "validation.passes=16",
        ),
        full=LOW,
    ),
)  # fmt: skip
