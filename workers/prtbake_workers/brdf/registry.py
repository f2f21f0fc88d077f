"""From the wire's description of a BRDF to the model itself."""

import numpy as np

from prtbake_storage.contract.brdf import (
    AbcSpec,
    BlinnPhongSpec,
    BrdfSpec,
    CookTorranceSpec,
    GgxSpec,
    LafortuneSpec,
    LambertSpec,
    NbrdfSpec,
    OrenNayarSpec,
    PhongSpec,
    SgdSpec,
    WardSpec,
)
from prtbake_workers.brdf.abc_microfacet import AbcMicrofacet
from prtbake_workers.brdf.base import Brdf, channels
from prtbake_workers.brdf.blinn_phong import BlinnPhong
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.ggx import Ggx
from prtbake_workers.brdf.lafortune import Lafortune, Lobe
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.brdf.nbrdf import Layer, Nbrdf
from prtbake_workers.brdf.oren_nayar import OrenNayar
from prtbake_workers.brdf.phong import Phong
from prtbake_workers.brdf.sgd import Sgd
from prtbake_workers.brdf.symmetrised import Symmetrised
from prtbake_workers.brdf.ward import Ward


def brdf_from_spec(spec: BrdfSpec) -> Brdf:
    """Build the BRDF that a spec describes: three channels if any of its reflectances has three."""
    match spec:
        case LambertSpec():
            return Lambert(*channels(spec.albedo))
        case PhongSpec():
            kd, ks = channels(spec.kd, spec.ks)
            return Phong(kd, ks, spec.exponent)
        case BlinnPhongSpec():
            kd, ks = channels(spec.kd, spec.ks)
            return BlinnPhong(kd, ks, spec.exponent)
        case CookTorranceSpec():
            kd, ks, f0 = channels(spec.kd, spec.ks, spec.f0)
            return CookTorrance(kd, ks, spec.m, f0)
        case GgxSpec():
            kd, ks, f0 = channels(spec.kd, spec.ks, spec.f0)
            return Ggx(kd, ks, spec.alpha, f0)
        case OrenNayarSpec():
            (albedo,) = channels(spec.albedo)
            return OrenNayar(albedo, spec.sigma)
        case WardSpec():
            kd, ks = channels(spec.kd, spec.ks)
            return Ward(kd, ks, spec.alpha_x, spec.alpha_y)
        case LafortuneSpec():
            kd, *weights = channels(spec.kd, *(lobe.weight for lobe in spec.lobes))
            lobes = tuple(
                Lobe(weight, (lobe.cx, lobe.cy, lobe.cz), lobe.exponent)
                for weight, lobe in zip(weights, spec.lobes, strict=True)
            )
            return Lafortune(kd, lobes)
        case SgdSpec():
            fields = spec.model_dump(exclude={"model"})
            return Sgd(**{name: np.asarray(value, np.float64) for name, value in fields.items()})
        case AbcSpec():
            kd, a = channels(spec.kd, spec.a)
            return AbcMicrofacet(kd, a, spec.b, spec.c, spec.ior)
        case NbrdfSpec():
            layers = tuple(
                Layer(np.asarray(layer.weights, np.float64), np.asarray(layer.biases, np.float64))
                for layer in spec.layers
            )
            return Symmetrised(Nbrdf(layers))
