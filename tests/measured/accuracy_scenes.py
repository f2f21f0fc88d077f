"""The studies of the page on what accuracy costs: scenes, and the axes that are swept."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from prtbake.client import Client
from prtbake_storage.contract.resources import EnvironmentRegistration, MeshRegistration

Axes = Mapping[str, Sequence[Any]]

QUALITY, CENTRES = "quality", "settings.bake.n_centres"
CLUSTERS, RANKS = "settings.compress.n_clusters", "settings.compress.ranks"
LADDER_NAME = "ladder"
"""The study whose only axis is the quality."""
FIGURE_4 = "figure4"
"""What is measured beside the studies."""

COOK_TORRANCE = {"model": "cook_torrance", "m": 0.5, "kd": 0.3, "ks": 0.7, "f0": 0.1}
VALIDATION = {"width": 128, "height": 96, "passes": 16, "samples": 256}
"""The same for every point, so that the points can be compared."""
QUICK_VALIDATION = {"width": 32, "height": 24, "passes": 2, "samples": 16}
QUICK_AXES = {QUALITY: ["draft", "low"], "settings.fit_light.n_lobes": [8]}


@dataclass(frozen=True)
class Scene:
    """A study of an asset: its mesh and light, the request beside them, the axes.

    ``mesh`` and ``light`` are a file of the real data, or a procedural one; ``texture`` a file.
    """

    name: str
    title: str
    about: str
    mesh: str | dict[str, Any]
    light: str | dict[str, Any]
    brdf: dict[str, Any]
    axes: Axes
    receiver: dict[str, Any] | None = None
    texture: str = ""
    registration: dict[str, Any] = field(default_factory=dict)

    def registered(self, client: Client, data: Path, *, quick: bool) -> dict[str, Any]:
        """Register what the scene is of, and give the study."""
        texture = client.upload(data / self.texture).digest if self.texture else None
        return self.study(self._mesh(client, data), self._light(client, data), texture, quick=quick)

    def study(
        self, mesh: str, environment: str, texture: str | None, *, quick: bool
    ) -> dict[str, Any]:
        """Give the study of what is registered under these names."""
        axes = dict(self.axes)
        if quick:
            axes = {path: values[:1] for path, values in axes.items()} | QUICK_AXES
        base = {
            "kind": "asset",
            "mesh": mesh,
            "environment": environment,
            "brdf": self.brdf,
            "receiver": self.receiver,
            "albedo_texture": texture,
            "settings": {"validation": QUICK_VALIDATION if quick else VALIDATION},
        }
        return {"kind": "study", "label": self.title, "base": base, "axes": axes}

    def _mesh(self, client: Client, data: Path) -> str:
        if isinstance(self.mesh, str):
            return client.add_mesh(data / "meshes" / self.mesh, **self.registration).id
        given = {"builtin": self.mesh, **self.registration}
        return client.register(MeshRegistration.model_validate(given)).id

    def _light(self, client: Client, data: Path) -> str:
        if isinstance(self.light, str):
            return client.add_environment(data / "environments" / self.light).id
        return client.register(EnvironmentRegistration.model_validate({"builtin": self.light})).id


TEAPOT = Scene(
    name="teapot",
    title="Teapot on a plane, Cook-Torrance",
    about="The teapot of 4,658 vertices, Cook-Torrance m 0.5, on a diffuse plane of 96 x 96 under a "
    "procedural sky with its sun.",
    mesh={"name": "teapot", "tessellation": 12},
    light={"name": "sun_sky"},
    brdf=COOK_TORRANCE,
    receiver={"resolution": 96},
    axes={
        QUALITY: ["draft", "low", "medium", "high"],
        CENTRES: [162, 642],
        CLUSTERS: [8, 32],
    },
)

SCENES: tuple[Scene, ...] = (
    TEAPOT,
    Scene(
        name="spot",
        title="Spot on a plane, diffuse, textured",
        about="Spot, 3,225 vertices with its texture as albedo, on a diffuse plane of 64 x 64, in the "
        "light of uffizi.hdr, a courtyard without a sun.",
        mesh="spot/spot_triangulated.obj",
        light="uffizi.hdr",
        brdf={"model": "lambert"},
        texture="meshes/spot/spot_texture.png",
        receiver={"resolution": 64},
        axes={
            QUALITY: ["draft", "low", "medium", "high", "reference"],
            CLUSTERS: [6, 24],
        },
    ),
    Scene(
        name="fandisk",
        title="Fandisk, Phong",
        about="The fandisk, a machine part whose edges above 40 degrees stay sharp, Phong with exponent "
        "16, by itself in the light of grace_probe.hdr, a nave with small bright windows.",
        mesh="fandisk.obj",
        registration={"crease_angle_deg": 40.0},
        light="grace_probe.hdr",
        brdf={"model": "phong", "kd": 0.3, "ks": 0.6, "exponent": 16.0},
        axes={
            QUALITY: ["draft", "low", "medium", "high"],
            CLUSTERS: [12, 48],
            RANKS: [None, [8, 32, 16]],
        },
    ),
    Scene(
        name="bunny",
        title="Bunny, Cook-Torrance",
        about="The Stanford bunny, 34,834 vertices, Cook-Torrance m 0.5, by itself under "
        "kloppenheim_05_1k.hdr, a field with a high sun.",
        mesh="stanford-bunny.obj",
        light="kloppenheim_05_1k.hdr",
        brdf=COOK_TORRANCE,
        axes={
            QUALITY: ["draft", "low", "medium"],
            CLUSTERS: [48, 192],
        },
    ),
)
"""Those of the frontier."""

LADDER = Scene(
    name=LADDER_NAME,
    title="The ladder, on the teapot",
    about="The teapot of 2,082 vertices on a plane of 48 x 48, else as above, at every quality, nothing "
    "else set.",
    mesh={"name": "teapot", "tessellation": 8},
    light=TEAPOT.light,
    brdf=COOK_TORRANCE,
    receiver={"resolution": 48},
    axes={QUALITY: ["draft", "low", "medium", "high", "reference"]},
)

ALL = (*SCENES, LADDER)
