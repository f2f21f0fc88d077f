import numpy as np
import pytest

from prtbake_storage.contract.brdf import brdf_adapter
from prtbake_workers.brdf.blinn_phong import BlinnPhong
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.ggx import Ggx
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.brdf.phong import Phong
from prtbake_workers.brdf.registry import brdf_from_spec


@pytest.mark.parametrize(
    ("model", "kind"),
    [
        ("lambert", Lambert),
        ("phong", Phong),
        ("blinn_phong", BlinnPhong),
        ("cook_torrance", CookTorrance),
        ("ggx", Ggx),
    ],
)
def test_every_model_of_the_contract_is_built(model, kind):
    brdf = brdf_from_spec(brdf_adapter.validate_python({"model": model}))
    assert type(brdf) is kind
    assert brdf.n_channels == 1


@pytest.mark.parametrize("field", ["kd", "ks", "f0"])
def test_one_coloured_field_makes_three_channels(field):
    spec = {"model": "cook_torrance", field: [0.9, 0.5, 0.1]}
    brdf = brdf_from_spec(brdf_adapter.validate_python(spec))
    assert brdf.n_channels == 3
    np.testing.assert_array_equal(getattr(brdf, field), [0.9, 0.5, 0.1])


def test_parameters_arrive_where_they_belong():
    brdf = brdf_from_spec(
        brdf_adapter.validate_python(
            {"model": "ggx", "kd": 0.1, "ks": 0.2, "alpha": 0.3, "f0": 0.4}
        )
    )
    assert (brdf.kd[0], brdf.ks[0], brdf.alpha, brdf.f0[0]) == (0.1, 0.2, 0.3, 0.4)
