"""The scenes of the measured results, as they are typed on the command line."""

from dataclasses import dataclass

DATA = "$PRTBAKE_DATA"
"""Stands for the folder of the real data, in what runs and in what is written of it."""

LIGHT = ("--environment", f"{DATA}/environments/kloppenheim_05_1k.hdr")
SIZE = ("--set", "render.width=480", "--set", "render.height=360")
MEDIUM = ("--quality", "medium", "--receiver", "96", *SIZE)
QUICK = (
    "--quality", "draft", "--receiver", "12", *SIZE,
    "--set", "validation.width=64", "--set", "validation.height=48",
    "--set", "validation.passes=2", "--set", "validation.samples=16",
)  # fmt: skip
"""Coarse enough to try the command: nothing that comes of it is a result."""

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
    """An asset job: ``options`` always, ``settings`` beside those of the quality in full."""

    name: str
    title: str
    about: str
    options: tuple[str, ...]
    settings: tuple[str, ...] = ()
    rank_pairs: bool = False

    def arguments(self, *, quick: bool) -> list[str]:
        """Return what follows ``prtbake submit asset``, with `DATA` for the folder."""
        return [*self.options, *LIGHT, *(QUICK if quick else (*MEDIUM, *self.settings))]

    def command(self, *, quick: bool) -> str:
        """Return the command as it is typed, an option a line."""
        words = self.arguments(quick=quick)
        lines = [f"{option} {value}" for option, value in zip(words[::2], words[1::2], strict=True)]
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
)  # fmt: skip
