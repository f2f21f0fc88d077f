"""Registration of BRDFs: what was understood, and what is refused and where."""

import json

import pytest

from prtbake_storage.errors import BrdfError
from support.local_stages import registered


def add(store, data, **registration):
    """Upload bytes and register them."""
    return registered(store, "brdf", blob=store.put_bytes(data), **registration)


def test_energy_reciprocity_and_isotropy_are_found(store):
    found = registered(store, "brdf", spec={"model": "ggx", "alpha": 0.3, "f0": 1.0})
    understood = found["understood"]
    assert understood["isotropic"]
    assert understood["reciprocity"]["reciprocal"]
    assert understood["energy"]["conserves"]
    assert 0.8 < understood["energy"]["normal_albedo"][0] < 1.0
    spec = json.loads(store.read_bytes(found["canonical"]))
    assert spec == understood["spec"]
    assert (spec["model"], spec["alpha"]) == ("ggx", 0.3)


def test_what_creates_light_is_taken_and_named(store):
    lobe = {"weight": 1.0, "cx": -1, "cy": -0.9, "cz": 1, "exponent": 2}
    found = registered(store, "brdf", spec={"model": "lafortune", "kd": 0.5, "lobes": [lobe]})
    assert not found["understood"]["energy"]["conserves"]
    assert found["understood"]["energy"]["max_albedo"] > 1.5
    assert not found["understood"]["isotropic"]


def test_json_in_a_file_is_the_same_as_in_the_request(store):
    spec = {"model": "oren_nayar", "sigma": 0.4, "albedo": [0.5, 0.4, 0.3]}
    from_file = add(store, json.dumps(spec).encode())
    assert from_file == registered(store, "brdf", spec=spec)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b'{"model": "ward", "alpha_x": 5}', "less than or equal to 1 .*ward/alpha_x"),
        (b'{"model": "velvet"}', "velvet"),
        (b'{"model": "lafortune", "lobes": [{"exponent": -1}]}', "lobes/0/exponent"),
        (b'{"model": ', "JSON"),
        (b'{"model": "lambert"}' + b" " * (1 << 20), "at most"),
    ],
)
def test_a_refusal_says_what_and_where(store, data, says):
    with pytest.raises(BrdfError, match=says) as caught:
        add(store, data)
    assert caught.value.pointer == "/blob"
