"""Registration of BRDFs: what was understood, and what is refused and where."""

import json

import numpy as np
import pytest

from prtbake_storage.contract.brdf import CookTorranceSpec
from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf import checks
from prtbake_workers.brdf.base import is_isotropic
from prtbake_workers.brdf.checks import check_energy
from prtbake_workers.brdf.distance import brdf_distance
from prtbake_workers.brdf.ggx import Ggx
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.brdf.ward import Ward
from prtbake_workers.jobs import register_brdf
from prtbake_workers.jobs.inputs import load_brdf
from support.keras_file import network
from support.local_stages import registered
from support.scattered_file import goniometer, grey_samples, spectral_text
from support.tensor_file import ggx_fields, oriented_fields, tensor_bytes


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


TABLE = b"name,kD_r,kD_g,kD_b,A_r,A_g,A_b,B,C,ior\npaint,0.1,0.2,0.3,5,5,5,500,1.5,1.4\n"


def test_a_material_of_a_table_becomes_its_spec(store):
    found = add(store, TABLE, material="paint")["understood"]
    assert (found["spec"]["model"], found["spec"]["kd"]) == ("abc", [0.1, 0.2, 0.3])
    assert (found["format"], found["material"]) == ("fit_table", "paint")
    assert found["energy"]["normal_albedo"][2] > found["energy"]["normal_albedo"][0]


@pytest.mark.parametrize(
    ("data", "material", "says"),
    [
        (TABLE, None, "name a material of the table: paint"),
        (TABLE, "gold", "no material 'gold' in the table: paint"),
        (b'{"model": "lambert"}', "gold", "one BRDF: it has no materials"),
    ],
)
def test_a_material_that_is_not_there_is_the_fields_fault(store, data, material, says):
    with pytest.raises(BrdfError, match=says) as caught:
        add(store, data, material=material)
    assert caught.value.pointer == "/material"


def test_a_network_is_made_symmetric_and_what_it_was_is_told(store):
    found = add(store, network())["understood"]
    assert found["format"] == "nbrdf"
    assert found["spec"]["model"] == "nbrdf"
    assert found["reciprocity"]["reciprocal"]
    assert not found["as_given"]["reciprocity"]["reciprocal"]
    assert 0.0 < found["as_given"]["asymmetry"] < 1.0


@pytest.fixture
def coarse_albedo(monkeypatch):
    """A quadrature whose figures are not read here: tests/brdf/test_checks.py has the fine one."""
    monkeypatch.setattr(checks, "NODES_A_PANEL", 2)


def test_a_tensor_file_becomes_a_measured_brdf(store, coarse_albedo):
    ggx = Ggx(np.zeros(3), np.ones(3), 0.5, np.array([0.9, 0.5, 0.2]))
    fields = ggx_fields(ggx, 0.5, n_lights=6, n=16, n_normals=48, n_rows=12)
    found = add(store, tensor_bytes(fields), filename="ggx_rgb.bsdf")
    understood = found["understood"]
    assert understood["spec"] == {"model": "measured", "format": "rgl", "data": found["canonical"]}
    assert understood["file"]["n_lights"] == 6
    assert understood["reciprocity"]["reciprocal"]
    assert not understood["as_given"]["reciprocity"]["reciprocal"]
    assert 0.0 < understood["as_given"]["asymmetry"] < 0.05
    loaded = load_brdf(store, understood["spec"])
    up = np.array([[0.0, 0.6, 0.8]])
    np.testing.assert_allclose(loaded.eval_brdf(up, up), ggx.eval_brdf(up, up), rtol=0.02)


class Askew:
    """A brushed surface with its grain 20 degrees off x."""

    n_channels = 3

    def eval_brdf(self, wi, wo):
        c, s = np.cos(np.deg2rad(20.0)), np.sin(np.deg2rad(20.0))
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return BRUSHED.eval_brdf(wi @ turn, wo @ turn)


BRUSHED = Ward(np.full(3, 0.2), np.array([0.6, 0.5, 0.4]), 0.3, 0.6)
COARSE = {"n_lights": 4, "n": 10, "n_normals": 24, "n_rows": 25}


@pytest.mark.parametrize(("reduction", "n_azimuths"), [(4, 5), (2, 9)])
def test_an_anisotropic_tensor_file_becomes_an_anisotropic_brdf(
    store, reduction, n_azimuths, monkeypatch, coarse_albedo
):
    monkeypatch.setattr(register_brdf, "N_ANGLES_ORIENTED", 1)
    fields = oriented_fields(
        BRUSHED, (0.3, 0.6), reduction=reduction, n_azimuths=n_azimuths, **COARSE
    )
    found = add(store, tensor_bytes(fields), filename="brushed_rgb.bsdf")
    understood = found["understood"]
    assert understood["spec"] == {"model": "measured", "format": "rgl", "data": found["canonical"]}
    assert not understood["isotropic"]
    assert understood["reciprocity"]["reciprocal"]
    assert (understood["file"]["reduction"], understood["file"]["n_azimuths"]) == (
        reduction, n_azimuths,
    )  # fmt: skip
    assert ("mirror_asymmetry" in understood["file"]) == (reduction == 2)
    # so coarse a table is not its own mirror image: the bilinear cells are not
    assert understood["file"].get("mirror_asymmetry", 0.0) < 0.1
    assert 0.0 < understood["as_given"]["asymmetry"] < 0.1
    loaded = load_brdf(store, understood["spec"])
    assert not is_isotropic(loaded)
    # tables as coarse as these; twin: the surface turned by a quarter is farther
    assert brdf_distance(loaded, BRUSHED).relative_l2 < 0.12
    assert brdf_distance(loaded, Ward(BRUSHED.kd, BRUSHED.ks, 0.6, 0.3)).relative_l2 > 0.2


class BrightNearGrazing:
    """Reflects most at a cosine of 0.25, more than it receives, and nothing at 0, 0.5 and 1."""

    n_channels = 1
    is_isotropic = False

    def eval_brdf(self, wi, wo):
        cosine = np.broadcast_to(wi[..., 2], np.broadcast_shapes(wi.shape, wo.shape)[:-1])
        return 1.2 / np.pi * np.maximum(1.0 - np.abs(cosine - 0.25) / 0.2, 0.0)[..., None]


def test_the_albedo_of_an_anisotropic_brdf_is_taken_near_grazing_light():
    found = check_energy(BrightNearGrazing(), n_angles=register_brdf.N_ANGLES_ORIENTED)
    assert found.cos_at_max == 0.25
    # the quadrature's error, see ENERGY_TOLERANCE
    assert found.max_albedo == pytest.approx(1.2, abs=1e-5)
    assert not found.conserves
    # negative twin: three angles step over it
    assert check_energy(BrightNearGrazing(), n_angles=3).conserves


def test_a_tensor_file_whose_grain_lies_askew_is_refused(store):
    fields = oriented_fields(Askew(), (0.3, 0.6), reduction=2, n_azimuths=9, **COARSE)
    with pytest.raises(BrdfError, match=r"not mirror-symmetric about its .* askew") as caught:
        add(store, tensor_bytes(fields), filename="askew_rgb.bsdf")
    assert caught.value.pointer == "/blob"


def test_scattered_samples_become_a_table_with_its_error(store):
    angles = goniometer(6, 8)
    brdf = brdf_from_spec(CookTorranceSpec(m=0.5))
    data = spectral_text(*angles, grey_samples(brdf, *angles))
    understood = add(store, data, filename="paint.brdf")["understood"]
    assert understood["spec"]["format"] == "scattered"
    assert understood["file"]["n_samples"] == len(angles[0])
    assert 0.0 < understood["file"]["held_out"]["relative_l2"] < 0.3
    loaded = load_brdf(store, understood["spec"])
    up = np.array([[0.0, 0.6, 0.8]])
    np.testing.assert_allclose(
        loaded.eval_brdf(up, up * [1, -1, 1]), brdf.eval_brdf(up, up * [1, -1, 1]) * [[1, 1, 1]],
        rtol=0.2,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b'{"model": "ward", "alpha_x": 5}', "less than or equal to 1 .*ward/alpha_x"),
        (b'{"model": "velvet"}', "velvet"),
        (b'{"model": "lafortune", "lobes": [{"exponent": -1}]}', "lobes/0/exponent"),
        (b'{"model": ', "JSON"),
        (b'{"model": "lambert"}' + b" " * (1 << 20), "at most"),
        (b"", "empty"),
        (b"# samples\n31\n400 700", "ends within its 31 wavelengths"),
        (b"\x00\x01 something else", "none of JSON"),
        (network()[:3000], "HDF5"),
        (b"tensor_file\0\1\0\xff\xff\xff\xff", "promises 4294967295 fields"),
    ],
)
def test_a_refusal_says_what_and_where(store, data, says):
    with pytest.raises(BrdfError, match=says) as caught:
        add(store, data)
    assert caught.value.pointer == "/blob"
