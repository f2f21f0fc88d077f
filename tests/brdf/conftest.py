import numpy as np
import pytest

from prtbake_storage.contract.brdf import (
    BlinnPhongSpec,
    CookTorranceSpec,
    GgxSpec,
    LafortuneLobe,
    LafortuneSpec,
    LambertSpec,
    OrenNayarSpec,
    PhongSpec,
    WardSpec,
)
from prtbake_workers.brdf.registry import brdf_from_spec

GOLD = (1.0, 0.77, 0.34)
SPECS = {
    "lambert": LambertSpec(albedo=0.6),
    "phong": PhongSpec(kd=0.3, ks=0.7, exponent=10.0),
    "blinn_phong": BlinnPhongSpec(kd=0.2, ks=0.8, exponent=40.0),
    "cook_torrance": CookTorranceSpec(),
    "ggx": GgxSpec(kd=0.1, ks=0.9, alpha=0.5, f0=0.5),
    "oren_nayar": OrenNayarSpec(albedo=0.8, sigma=0.5),
    "ward": WardSpec(kd=0.1, ks=0.8, alpha_x=0.3, alpha_y=0.3),
    "coloured_lambert": LambertSpec(albedo=(0.7, 0.2, 0.1)),
    "coloured_phong": PhongSpec(kd=(0.4, 0.1, 0.0), ks=(0.1, 0.5, 0.6), exponent=10.0),
    "coloured_blinn_phong": BlinnPhongSpec(kd=0.0, ks=GOLD, exponent=20.0),
    "coloured_cook_torrance": CookTorranceSpec(kd=(0.5, 0.3, 0.1), ks=0.5, m=0.4, f0=GOLD),
    "coloured_ggx": GgxSpec(kd=0.0, ks=1.0, alpha=0.4, f0=GOLD),
    "coloured_lafortune": LafortuneSpec(
        kd=(0.3, 0.1, 0.0),
        lobes=(
            LafortuneLobe(weight=(0.2, 0.8, 0.5), cx=-0.9, cy=-0.9, cz=0.95, exponent=12.0),
            LafortuneLobe(weight=0.4, cx=0.8, cy=0.8, cz=1.0, exponent=6.0),
        ),
    ),
}


@pytest.fixture(params=SPECS)
def brdf(request):
    return brdf_from_spec(SPECS[request.param])


@pytest.fixture
def directions():
    """Give n random unit directions above the horizon."""

    def draw(n, seed=1):
        rng = np.random.default_rng(seed)
        z, phi = rng.random(n), 2 * np.pi * rng.random(n)
        s = np.sqrt(1 - z * z)
        return np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)

    return draw
