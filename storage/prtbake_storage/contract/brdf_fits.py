"""Fits of measured BRDFs as JSON: parameters that others have published, one model a class."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from prtbake_storage.contract.base import Wire

NotNegative = Annotated[float, Field(ge=0.0, le=1e9)]
NotNegativeRgb = tuple[NotNegative, NotNegative, NotNegative]
AlphaChannel = Annotated[float, Field(ge=1e-9, le=1e3)]
PowerChannel = Annotated[float, Field(ge=0.0, le=10.0)]
FresnelChannel = Annotated[float, Field(ge=-1e3, le=1e3)]
SteepnessChannel = Annotated[float, Field(ge=0.0, le=1e40)]
ExponentChannel = Annotated[float, Field(ge=0.0, le=1e4)]
AngleChannel = Annotated[float, Field(ge=-3.2, le=3.2)]
HIDDEN_MAX = 64


class SgdSpec(Wire):
    """Shifted gamma distribution (Bagher, Soler, Holzschuch 2012), every parameter a channel.

    ``(rho_d + rho_s F D G(wi) G(wo) / (cos_i cos_o)) / pi``, with c = wi.h:
    F = f0 - c f1 + (1 - c)^5 (1 - f0); D = kappa e^-x / (pi x^p cos^4) of x = alpha + tan^2 / alpha
    of the half vector; G = 1 + lam (1 - exp(c max(0, theta - theta0)^k)) within [0, 1].
    """

    model: Literal["sgd"] = "sgd"
    rho_d: NotNegativeRgb
    rho_s: NotNegativeRgb
    alpha: tuple[AlphaChannel, AlphaChannel, AlphaChannel]
    p: tuple[PowerChannel, PowerChannel, PowerChannel]
    f0: tuple[FresnelChannel, FresnelChannel, FresnelChannel]
    f1: tuple[FresnelChannel, FresnelChannel, FresnelChannel]
    kappa: NotNegativeRgb
    lam: NotNegativeRgb
    c: tuple[SteepnessChannel, SteepnessChannel, SteepnessChannel]
    k: tuple[ExponentChannel, ExponentChannel, ExponentChannel]
    theta0: tuple[AngleChannel, AngleChannel, AngleChannel]


class AbcSpec(Wire):
    """ABC microfacets (Low, Kronander, Ynnerman, Unger 2012).

    ``kd / pi + F D G / (pi cos_i cos_o)`` with D = a / (1 + b (1 - cos))^c of the half vector, the
    Fresnel term of a dielectric of index ``ior``, and Cook-Torrance's G.
    """

    model: Literal["abc"] = "abc"
    kd: NotNegativeRgb
    a: NotNegativeRgb
    b: NotNegative
    c: Annotated[float, Field(ge=0.0, le=100.0)]
    ior: Annotated[float, Field(ge=1.0, le=1e3)]


class DenseLayer(Wire):
    """A layer of a network: ``weights`` has a row an input and a column an output."""

    weights: Annotated[tuple[tuple[float, ...], ...], Field(min_length=1, max_length=HIDDEN_MAX)]
    biases: Annotated[tuple[float, ...], Field(min_length=1, max_length=HIDDEN_MAX)]

    @model_validator(mode="after")
    def _rectangular(self) -> "DenseLayer":
        for index, row in enumerate(self.weights):
            if len(row) != len(self.biases):
                raise ValueError(
                    f"row {index} of the weights has {len(row)} numbers beside "
                    f"{len(self.biases)} biases"
                )
        if max(abs(x) for row in (*self.weights, self.biases) for x in row) > 1e6:
            raise ValueError("a weight or a bias exceeds 1e6")
        return self


class NbrdfSpec(Wire):
    """Neural BRDF (Sztrajman, Rainer, Ritschel, Weyrich 2021).

    Six inputs (half and difference vector in the half vector's meridian), two hidden layers of
    rectified linear units, three outputs y; the BRDF is exp(y) - 1.
    """

    model: Literal["nbrdf"] = "nbrdf"
    layers: tuple[DenseLayer, DenseLayer, DenseLayer]

    @model_validator(mode="after")
    def _chained(self) -> "NbrdfSpec":
        widths = [6, *(len(layer.biases) for layer in self.layers)]
        rows = [len(layer.weights) for layer in self.layers]
        for index, (width, n_rows) in enumerate(zip(widths, rows, strict=False)):
            if width != n_rows:
                raise ValueError(f"layer {index} takes {n_rows} numbers where {width} come in")
        if widths[-1] != 3:
            raise ValueError(f"the last layer gives {widths[-1]} numbers, not 3")
        return self
