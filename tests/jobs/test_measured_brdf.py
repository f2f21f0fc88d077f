"""A measured BRDF from its upload through every stage of the main job."""

import numpy as np
import pytest

from prtbake_storage.contract.brdf import BrdfSpec, brdf_adapter
from prtbake_storage.hdf5.brdf import read_brdf
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.jobs.inputs import load_brdf
from prtbake_workers.jobs.registry import REGISTRY
from support.local_stages import registered, run_stages
from support.merl_file import COLOURED, coloured_samples, merl_bytes
from support.scenes import asset_request, context_of, run_until


@pytest.fixture(scope="module")
def table(store):
    """Registration of COLOURED, sampled as MERL would have measured it, with bad samples in it."""
    samples = coloured_samples().copy()
    samples[:, 40:42, 20:25, 30:60] = -1.0
    return registered(
        store, "brdf", blob=store.put_bytes(merl_bytes(samples)), filename="ggx.binary"
    )


def test_the_registration_tells_what_was_found(table, store):
    understood = table["understood"]
    assert understood["spec"] == {"model": "measured", "format": "merl", "data": table["canonical"]}
    assert understood["format"] == "merl"
    assert understood["file"]["n_invalid_above_horizon"] == 2 * 5 * 30
    assert understood["reciprocity"]["max_relative"] == 0.0
    assert understood["energy"]["conserves"]
    assert understood["isotropic"]
    file = read_brdf(store.local_path(table["canonical"]))
    assert file.report == understood["file"]
    assert file.arrays["values"].min() >= 0.0


def test_the_energy_found_is_that_of_the_model(table):
    from prtbake_workers.brdf.checks import check_energy

    model = check_energy(brdf_from_spec(COLOURED), n_angles=3)
    # interpolation between bins
    np.testing.assert_allclose(
        table["understood"]["energy"]["normal_albedo"], model.normal_albedo, rtol=2e-3
    )


def test_requests_cannot_name_a_table_themselves(table):
    """Only registering a blob makes one, so that no request reads what it did not upload."""
    with pytest.raises(ValueError, match="measured"):
        brdf_adapter.validate_python(table["understood"]["spec"])
    assert "MeasuredSpec" not in str(BrdfSpec)


def test_it_is_baked_and_found_again_by_what_the_transfer_says(table, store):
    request = asset_request(brdf="brdf-" + "0" * 16, settings={"bake": {"n_terms": 16}})
    spec = table["understood"]["spec"]
    context = context_of(
        store,
        request,
        {"builtin": {"name": "icosphere", "tessellation": 2}},
        {"builtin": {"name": "sun_sky", "width": 64}},
    )
    context["brdf"] = {"spec": spec, "canonical": table["canonical"]}
    results = run_until(store, request, context, "join")
    # what the terms lose of the table is what they lose of the model it was sampled from
    lost = results["plan"][0]["errors"]["object"]
    model = factorise(brdf_from_spec(COLOURED), n_terms=16)
    assert lost == pytest.approx(model.energy_lost, rel=0.05)
    with open_transfer(store.local_path(results["join"][0]["transfer"])) as transfer:
        material = dict(transfer.header.parts[0].material)
        assert transfer.header.parts[0].n_terms == 16
    assert material == spec
    # validation loads the BRDF by the same words
    up = np.array([[0.0, 0.6, 0.8]])
    np.testing.assert_allclose(
        load_brdf(store, material).eval_brdf(up, up),
        brdf_from_spec(COLOURED).eval_brdf(up, up),
        rtol=0.02,
    )


def test_estimates_read_it_too(table, store):
    request = asset_request(brdf="brdf-" + "0" * 16) | {"kind": "asset"}
    context = context_of(
        store,
        request,
        {"builtin": {"name": "icosphere", "tessellation": 2}},
        {"builtin": {"name": "sun_sky", "width": 64}},
    )
    context["brdf"] = {"spec": table["understood"]["spec"], "canonical": table["canonical"]}
    quick = {"request": request}
    results = run_stages(REGISTRY.stages("estimate", quick, context), store)
    assert REGISTRY.finish("estimate", quick, context, results).result["total_seconds"] > 0
