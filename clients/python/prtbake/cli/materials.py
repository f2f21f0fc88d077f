"""``--material NAME=BRDF``, ``--material-texture NAME=PNG`` and ``--receiver-texture PNG``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from prtbake.cli.assignments import legal_names, read_json
from prtbake.cli.sources import brdf_value, existing_file
from prtbake.client import Client
from prtbake_storage.contract.materials import Material

MATERIAL, TEXTURE = "--material", "--material-texture"
RECEIVER_TEXTURE = "--receiver-texture"

Materials = Annotated[
    list[str] | None,
    typer.Option(
        MATERIAL,
        metavar="NAME=BRDF",
        help="BRDF of a group of the mesh's faces, or its whole material as JSON; repeatable.",
    ),
]
MaterialTextures = Annotated[
    list[str] | None,
    typer.Option(
        TEXTURE,
        metavar="NAME=PNG",
        help="Albedo of a group with a --material: a file, or sha256:...; repeat for several.",
    ),
]
ReceiverTexture = Annotated[
    str | None,
    typer.Option(metavar="PNG", help="Albedo of the plane: a file, or sha256:..."),
]


@dataclass(frozen=True)
class MaterialWords:
    """What the options say, checked as far as this side can, with nothing uploaded yet."""

    brdfs: dict[str, str]
    textures: dict[str, str | Path]
    receiver: str | Path | None

    @classmethod
    def read(
        cls, materials: list[str] | None, textures: list[str] | None, receiver: str | None
    ) -> "MaterialWords":
        """Split names from what stands behind them, and look whether the files are there."""
        brdfs = _named(materials, MATERIAL)
        pictures = _named(textures, TEXTURE)
        for name in pictures:
            if name not in brdfs:
                raise typer.BadParameter(
                    f"{name!r} has no BRDF: give it one with {MATERIAL}", param_hint=TEXTURE
                )
        return cls(
            brdfs,
            {name: _picture(text, TEXTURE) for name, text in pictures.items()},
            None if receiver is None else _picture(receiver, RECEIVER_TEXTURE),
        )

    def add_to(self, client: Client, scene: dict[str, Any]) -> None:
        """Register and upload what they name, and write it into a request."""
        materials = {name: _material(client, text) for name, text in self.brdfs.items()}
        for name, found in self.textures.items():
            materials[name]["albedo_texture"] = _digest(client, found)
        if materials:
            scene["materials"] = materials
        if self.receiver is not None:
            # a texture calls for a plane to lie on
            plane = scene.setdefault("receiver", {})
            plane["albedo_texture"] = _digest(client, self.receiver)


def _material(client: Client, text: str) -> dict[str, Any]:
    """Read a BRDF, or JSON with a ``brdf`` in it and what else a material has."""
    if text.lstrip().startswith("{"):
        given = read_json(text, MATERIAL)
        if "brdf" in given:
            return legal_names(given, Material.model_fields, "a material", MATERIAL)
    return {"brdf": brdf_value(client, text, option=MATERIAL)}


def _named(pairs: list[str] | None, option: str) -> dict[str, str]:
    named: dict[str, str] = {}
    for pair in pairs or []:
        name, equals, text = pair.partition("=")
        if not (name and equals and text):
            raise typer.BadParameter(f"{pair!r} is not NAME=...", param_hint=option)
        if name in named:
            raise typer.BadParameter(f"{name!r} is given twice", param_hint=option)
        named[name] = text
    return named


def _picture(text: str, option: str) -> str | Path:
    return text if text.startswith("sha256:") else existing_file(text, option)


def _digest(client: Client, found: str | Path) -> str:
    return found if isinstance(found, str) else client.upload(found).digest
