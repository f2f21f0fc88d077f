"""The glossy matrix kind: harmonics on both sides, through to pictures and report."""

import json

import numpy as np
import pytest

from prtbake.asset import Asset
from prtbake_storage.decode.light import LightFit
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.basis.sh import HemisphereBasis
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.factorise_harmonic import factorise_harmonic
from prtbake_workers.brdf.harmonic_factorisation import HarmonicFactorisation
from prtbake_workers.brdf.stored_factorisation import factorisation_from_tables
from prtbake_workers.jobs.inputs import load_brdf
from support.scenes import (
    asset_request,
    ball_context,
    relative_difference,
    run_asset,
    run_until,
)

PHONG = {"model": "phong", "kd": 0.3, "ks": 0.7, "exponent": 6.0}
BAKE = {"basis": "sh", "sh_order": 6, "factorisation": "sh", "view_order": 4, "cube_resolution": 12}

LIGHT = LightFit(
    centres=np.array([[0.0, 0.8, 0.6], [0.6, 0.48, -0.64]]),
    bandwidths=np.array([6.0, 1.0]),
    coefficients=np.array([[2.0, 1.0, 0.5], [0.3, 0.6, 0.9]]),
)


def request_of(bake=BAKE, **changes):
    request = asset_request(
        brdf=PHONG, effects={"interreflection": "off"}, receiver={"resolution": 8}, **changes
    )
    request["settings"]["bake"] = bake
    request["settings"]["compress"] |= {"n_clusters": 2, "ranks": [16, 36, 24]}
    request["settings"]["validation"] = {"width": 32, "height": 24, "passes": 2, "samples": 32}
    return request


@pytest.fixture(scope="module")
def finished(store):
    request = request_of()
    context = ball_context(store, request)
    return context, run_asset(store, request, context)


def test_the_transfer_has_a_row_a_harmonic_of_the_view(store, finished):
    _, results = finished
    with open_transfer(store.local_path(results["join"][0]["transfer"])) as transfer:
        part = transfer.header.parts[0]
        assert transfer.read(0).shape == (part.n_vertices, 16, 36)  # N_r x N_i
        # a Lambertian part keeps its one term
        assert transfer.header.parts[1].n_terms == 1
    read = factorisation_from_tables(part.factorisation)
    assert isinstance(read, HarmonicFactorisation)
    brdf = load_brdf(store, dict(part.material))
    expected = factorise_harmonic(brdf, 4, HemisphereBasis(4).kept)
    np.testing.assert_array_equal(read.view_coefficients, expected.view_coefficients)


def test_the_report_says_what_the_harmonics_leave(store, finished):
    _, results = finished
    report = json.loads(store.read_bytes(results["report"][0]["json"]))
    assert report["transfer"] == {"basis": "sh", "coefficients": 36, "factorisation": "sh"}
    assert report["settings"]["bake"]["view_order"] == 4
    assert report["settings"]["bake"]["term_energy_lost"] is None
    lost = report["errors"]["plan"]["object"]
    assert 1e-4 < lost < 0.05
    assert any(f"leave {lost:.2%} of the BRDF's energy" in note for note in report["notes"])
    lines = {line["name"]: line["error"] for line in report["budget"]["lines"]}
    # the tables and the view texture hold the harmonics as they hold the products of an SVD
    assert lines["BRDF tables"] < 0.01
    assert (
        "spherical harmonics of the view" in store.read_bytes(results["report"][0]["html"]).decode()
    )


def colours(store, results):
    """Every vertex' colour from an eye above, under two lobes."""
    asset = Asset.open(store.local_path(results["quantise"][0]["asset"]))
    return asset.vertex_radiance((1.0, 2.0, 3.0), LIGHT)


def test_colours_are_those_of_the_best_products_within_what_harmonics_leave(store, finished):
    context, results = finished
    own = colours(store, results)
    request = request_of(bake=BAKE | {"factorisation": "svd", "view_order": None, "n_terms": 16})
    best = colours(store, run_until(store, request, context, "quantise"))
    difference = relative_difference(own, best)
    # 1 % of the BRDF's energy is a tenth of its amplitude, of which soft light sees a part
    assert 1e-4 < difference < 0.02  # 0.011 measured, 0.13 for the twin
    # negative twin: without views
    request = request_of() | {"effects": {"interreflection": "off", "view_dependence": "off"}}
    plain = colours(store, run_until(store, request, context, "quantise"))
    assert relative_difference(plain, best) > 3 * difference


def test_without_view_dependence_the_best_single_product_is_baked(store):
    request = request_of() | {"effects": {"view_dependence": "off"}}
    results = run_until(store, request, ball_context(store, request), "plan")
    (planned,) = results["plan"]
    assert [part["n_terms"] for part in planned["plan"]["parts"]] == [1, 1]
    brdf = load_brdf(store, PHONG)
    assert planned["errors"]["object"] == factorise(brdf, n_terms=1).energy_lost
