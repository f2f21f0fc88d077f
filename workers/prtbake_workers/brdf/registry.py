"""From the wire's description of a BRDF to the model itself."""

from prtbake_storage.contract.brdf import (
    BlinnPhongSpec,
    BrdfSpec,
    CookTorranceSpec,
    GgxSpec,
    LambertSpec,
    PhongSpec,
)
from prtbake_workers.brdf.base import Brdf, channels
from prtbake_workers.brdf.blinn_phong import BlinnPhong
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.ggx import Ggx
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.brdf.phong import Phong


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
