"""BRDFs as JSON: one model a class, told apart by ``model``."""

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from prtbake_storage.contract.base import Fraction, Positive, Rgb, Wire

Reflectance = Fraction | Rgb
"""One number for grey, three for linear Rec.709."""


class LambertSpec(Wire):
    """Diffuse: ``albedo / pi``."""

    model: Literal["lambert"] = "lambert"
    albedo: Reflectance = 1.0


class PhongSpec(Wire):
    """Phong: ``kd / pi + ks (n + 2) / (2 pi) max(0, wo . r)^n``; at normal view it reflects ks."""

    model: Literal["phong"] = "phong"
    kd: Reflectance = 0.0
    ks: Reflectance = 1.0
    exponent: Annotated[float, Field(ge=1.0, le=10_000.0)] = 10.0


class BlinnPhongSpec(Wire):
    """Blinn: ``kd / pi + ks (n + 2)(n + 4) / (8 pi (2^(-n/2) + n)) (n . h)^n``; as Phong's ks."""

    model: Literal["blinn_phong"] = "blinn_phong"
    kd: Reflectance = 0.0
    ks: Reflectance = 1.0
    exponent: Annotated[float, Field(ge=1.0, le=10_000.0)] = 40.0


class CookTorranceSpec(Wire):
    """Cook-Torrance: ``kd / pi + ks F D G / (4 cos_i cos_o)``.

    D = exp(-tan^2 / m^2) / (pi m^2 cos^4) of the half vector (Beckmann, ``m`` the slope), Schlick's
    F = f0 + (1 - f0)(1 - wo.h)^5, G = min(1, 2 (n.h) min(cos_i, cos_o) / (wo.h)).
    """

    model: Literal["cook_torrance"] = "cook_torrance"
    kd: Reflectance = 0.3
    ks: Reflectance = 0.7
    m: Annotated[float, Field(ge=0.01, le=2.0)] = 0.5
    f0: Fraction | Rgb = 0.1


class GgxSpec(Wire):
    """Trowbridge-Reitz (GGX): ``kd / pi + ks F D G / (4 cos_i cos_o)``.

    D = alpha^2 / (pi (alpha^2 cos^2 + sin^2)^2) of the half vector (``alpha`` itself, not its
    root), Schlick's F as in Cook-Torrance, Smith's height-correlated G.
    """

    model: Literal["ggx"] = "ggx"
    kd: Reflectance = 0.0
    ks: Reflectance = 1.0
    alpha: Annotated[float, Field(ge=0.01, le=1.0)] = 0.5
    f0: Fraction | Rgb = 0.04


BrdfSpec = Annotated[
    LambertSpec | PhongSpec | BlinnPhongSpec | CookTorranceSpec | GgxSpec,
    Field(discriminator="model"),
]
brdf_adapter: TypeAdapter[LambertSpec | PhongSpec | BlinnPhongSpec | CookTorranceSpec | GgxSpec] = (
    TypeAdapter(BrdfSpec)
)
__all__ = [
    "BlinnPhongSpec", "BrdfSpec", "CookTorranceSpec", "GgxSpec", "LambertSpec", "PhongSpec",
    "Positive", "brdf_adapter",
]  # fmt: skip
