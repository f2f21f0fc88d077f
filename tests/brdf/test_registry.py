import numpy as np
import pytest
from pydantic import ValidationError

from prtbake_storage.contract.brdf import brdf_adapter
from prtbake_workers.brdf.blinn_phong import BlinnPhong
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.ggx import Ggx
from prtbake_workers.brdf.lafortune import Lafortune
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.brdf.oren_nayar import OrenNayar
from prtbake_workers.brdf.phong import Phong
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.brdf.ward import Ward


@pytest.mark.parametrize(
    ("model", "kind"),
    [
        ("lambert", Lambert),
        ("phong", Phong),
        ("blinn_phong", BlinnPhong),
        ("cook_torrance", CookTorrance),
        ("ggx", Ggx),
        ("oren_nayar", OrenNayar),
        ("ward", Ward),
        ("lafortune", Lafortune),
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


def test_the_lobes_of_a_lafortune_arrive_in_order():
    brdf = brdf_from_spec(
        brdf_adapter.validate_python(
            {
                "model": "lafortune",
                "kd": 0.1,
                "lobes": [
                    {"weight": [0.1, 0.2, 0.3], "cx": -0.9, "cy": -0.8, "cz": 0.7, "exponent": 5},
                    {"weight": 0.5, "cx": 1, "cy": 1, "cz": 1, "exponent": 9},
                ],
            }
        )
    )
    first, second = brdf.lobes
    np.testing.assert_array_equal(brdf.kd, [0.1, 0.1, 0.1])
    np.testing.assert_array_equal(first.weight, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(second.weight, [0.5, 0.5, 0.5])
    assert (first.factors, first.exponent) == ((-0.9, -0.8, 0.7), 5.0)
    assert (second.factors, second.exponent) == ((1.0, 1.0, 1.0), 9.0)


def test_the_slopes_of_a_ward_are_not_exchanged():
    brdf = brdf_from_spec(
        brdf_adapter.validate_python({"model": "ward", "alpha_x": 0.1, "alpha_y": 0.4})
    )
    assert (brdf.alpha_x, brdf.alpha_y) == (0.1, 0.4)


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ({"model": "lafortune", "lobes": []}, "at least 1"),
        ({"model": "lafortune", "lobes": [{"cz": 2.0, "exponent": 1000}]}, r"peak is 10\^301"),
        ({"model": "lafortune", "lobes": [{"weight": -1}]}, "greater than or equal to 0"),
        ({"model": "ward", "alpha_x": 0.001}, "0.01"),
        ({"model": "oren_nayar", "sigma": 2.0}, "1.57"),
        ({"model": "ward", "alpha_x": float("nan")}, "finite"),
    ],
)
def test_what_no_surface_has_is_refused(spec, says):
    with pytest.raises(ValidationError, match=says):
        brdf_adapter.validate_python(spec)
