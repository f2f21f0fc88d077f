"""The main job's stages, for real, in this process."""

import html
import json
from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.contract.jobs import job_request_adapter
from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.resources import read_mesh
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_storage.hdf5.writer import write_asset
from prtbake_workers.jobs import report
from prtbake_workers.jobs.estimate import predict
from prtbake_workers.jobs.plan_notes import repairs
from prtbake_workers.jobs.registry import REGISTRY
from support.local_stages import registered, run_stages
from support.scenes import (
    SMALL,
    asset_request,
    context_of,
    run_until,
    teapot_context,
    validation_of,
)


def finished(glossy_asset):
    request, context, results = glossy_asset
    return REGISTRY.finish("asset", request, context, results)


def test_every_promised_file_is_left(glossy_asset, store):
    files = {file.name: file for file in finished(glossy_asset).artefacts}
    assert set(files) == {
        "transfer.h5", "asset.h5", "asset-float32.h5", "light.h5", "preview-front.png",
        "preview-front.exr", "validation-front.png", "validation-back.png", "report.json",
        "report.html",
    }  # fmt: skip
    assert all(store.size(file.digest) > 0 for file in files.values())


def test_the_result_says_error_and_cost_of_every_stage(glossy_asset):
    result = finished(glossy_asset).result
    assert set(result["errors"]) == {
        "plan", "bake", "bounces", "compress", "quantise", "fit_light",
    }  # fmt: skip
    assert all(0 <= error < 1 for stage in result["errors"].values() for error in stage.values())
    assert result["errors"]["bake"]["object"] > 0
    assert result["seconds"]["total"] > 0
    assert result["bytes"]["asset.h5"] < result["bytes"]["transfer.h5"]
    assert {effect["effect"] for effect in result["effects"]} >= {"self_shadowing"}


def test_every_own_error_is_named_by_its_norm(glossy_asset, store):
    *_, results = glossy_asset
    written = results["report"][0]
    stages = json.loads(store.read_bytes(written["json"]))["stages"]
    page = store.read_bytes(written["html"]).decode()
    for stage in stages:
        assert bool(stage["errors_are"]) == bool(stage["errors"]), stage["name"]
        if stage["errors"]:
            assert html.escape(stage["errors_are"]).replace("&#x27;", "&#39;") in page
    named = {stage["name"]: stage["errors_are"] for stage in stages if stage["errors"]}
    assert len(set(named.values())) == 6
    # neither is weighted by area
    assert "area" not in named["plan"] + named["fit_light"]


def test_the_projection_error_holds_between_the_directions_too(glossy_asset):
    """12 x 12 texels a face resolve 162 SRBFs: in other directions the error is little larger."""
    bake = finished(glossy_asset).result["errors"]["bake"]
    for part in ("object", "receiver"):
        # larger for shadows finer than a texel; 1.5 was measured on the object
        assert 0.8 < bake[f"{part} in other directions"] / bake[part] < 2.0
    assert finished(glossy_asset).result["numerics"]["gram_defect_of_directions"] < 0.01


def test_directions_that_do_not_resolve_the_basis_are_not_reported_as_exact(store):
    """96 directions for 162 SRBFs: the fit passes through its samples, and the report says so."""
    request = asset_request(receiver=None, settings={"bake": {"cube_resolution": 4}})
    results = run_until(store, request, teapot_context(store, request, 2), "join")
    gathered = report.gather("", results)
    (bake,) = (stage for stage in gathered["stages"] if stage["name"] == "bake")
    assert bake["errors"]["object"] < 1e-6
    assert bake["errors"]["object in other directions"] > 0.05
    assert gathered["numerics"]["gram_defect_of_directions"] > 0.5
    assert any(
        "96 directions do not resolve 162 SRBFs" in note for note in gathered["plan"]["notes"]
    )


def test_the_report_says_what_a_step_more_would_cost(glossy_asset, store):
    """As the plan of the same request at that quality predicts it, from the BRDF itself."""
    request, context, results = glossy_asset
    written = results["report"][0]
    ladder = json.loads(store.read_bytes(written["json"]))["ladder"]
    (own,) = (step for step in ladder if step["quality"] is None)
    (more,) = (step for step in ladder if step["quality"] == "low")  # draft is the lowest
    body = job_request_adapter.validate_python(request | {"kind": "asset", "quality": "low"})
    expected = predict(body, body.model_dump(mode="json"), context, store)
    terms = [part["n_terms"] for part in expected.plan["parts"]]
    assert more["terms"] == terms
    assert terms[0] > own["terms"][0]
    # the tables of the BRDF, 8 % of this file, are those of the job's own terms
    assert more["asset_bytes"] == pytest.approx(expected.artefact_bytes["asset.h5"], rel=0.12)
    making = [s for name, s in expected.seconds.items() if name not in ("render", "validate")]
    # as for an environment whose size no plan knows
    assert more["seconds"] == pytest.approx(sum(making), rel=0.2)
    assert more["seconds"] > own["seconds"]
    assert own["measured_bytes"] == results["quantise"][0]["bytes"]
    assert own["measured_seconds"] > 0
    page = store.read_bytes(written["html"]).decode()
    assert "A step more or less" in page
    found = json.loads(store.read_bytes(written["json"]))["frontier"]
    assert found["asset"]["error"] == finished(glossy_asset).result["budget"]["total"]
    (step,) = found["steps"]
    assert step["quality"] == "low"
    assert 0 < step["error"] < found["asset"]["error"]
    # terms are a line that the step changes, vertices one that no quality does
    lines = found["asset"]["lines"]
    assert step["lines"]["K terms"] < lines["K terms"]
    assert step["lines"]["vertex interpolation"] == lines["vertex interpolation"]
    assert "Error beside them" in page


def test_every_stage_says_the_bytes_that_it_left(glossy_asset, store):
    _, _, results = glossy_asset
    (planned,), (quantised,), (rendered,) = (
        results[name] for name in ("plan", "quantise", "render")
    )
    left = {
        "plan": [planned["scene"], planned["projection"]],
        "bake": [tile["tile"] for tile in results["bake"]],
        "scattering": [],
        "bounces": [block["bounces"] for block in results["bounces"]],
        "add_bounces": [tile["tile"] for tile in results["add_bounces"]],
        "join": [results["join"][0]["transfer"]],
        "compress": [part["factors"] for part in results["compress"]],
        "quantise": [quantised["asset"], quantised["exact"]],
        "fit_light": [results["fit_light"][0]["light"]],
        "render": [picture["digest"] for picture in rendered["pictures"]],
        "validate": [
            digest
            for camera in results["validate"]
            for view in camera["views"]
            for digest in view["pictures"].values()
        ],
    }
    stages = results["report"][0]["report"]["stages"]
    stated = {stage["name"]: stage["bytes"] for stage in stages}
    assert stated == {
        name: sum(store.size(digest) for digest in digests) for name, digests in left.items()
    }
    # nothing scatters light inside
    assert [name for name, count in stated.items() if count == 0] == ["scattering"]


def test_the_stated_compression_error_is_that_of_the_files(glossy_asset, store):
    """Reconstruct the float32 asset and hold it against the transfer file, independently."""
    _, _, results = glossy_asset
    asset = read_asset(store.local_path(results["quantise"][0]["exact"]))
    with open_transfer(store.local_path(results["join"][0]["transfer"])) as transfer:
        for index, part in enumerate(asset.parts):
            truth = transfer.read(index).astype(np.float64)
            areas = transfer.header.parts[index].areas
            error = ((reconstruct(part, slice(None)) - truth) ** 2).sum(axis=(1, 2))
            ratio = (areas @ error) / (areas @ (truth**2).sum(axis=(1, 2)))
            stated = results["compress"][index]["errors"][part.name]
            # float32 factors against float64 sums
            assert stated == pytest.approx(ratio, rel=1e-3)


def test_the_asset_says_how_it_was_made(glossy_asset, store):
    request, _, results = glossy_asset
    provenance = read_asset(store.local_path(results["quantise"][0]["asset"])).provenance
    plan = results["plan"][0]["plan"]
    made = provenance["compress"]
    assert [part["n_clusters"] for part in made["parts"]] == [
        part["compression"]["n_clusters"] for part in plan["parts"]
    ]
    assert [part["method"] for part in made["parts"]] == ["cta", "cpca"]
    assert made["max_iterations"] == request["settings"]["compress"]["max_iterations"]
    assert made["threads"] == CompressSettings().threads
    assert provenance["tiles"] == [[list(tile) for tile in part["tiles"]] for part in plan["parts"]]
    assert provenance["bake"]["threads"] == 1
    assert provenance["quality"] == request["quality"]
    assert provenance["inputs"]["brdf"] == request["brdf"]
    assert {"numpy", "embreex"} <= set(made["versions"])


def test_a_narrow_lobe_gets_finer_texels_and_a_note_where_they_are_too_few(store):
    """A lobe of exponent 500 on a small sphere: more than 256 texels would be due."""
    request = asset_request(
        brdf={"model": "phong", "kd": 0.0, "ks": 0.9, "exponent": 500.0}, receiver=None
    )
    request["settings"]["bake"] |= {"n_terms": 24}
    sphere = {"builtin": {"name": "icosphere", "tessellation": 1}}
    sky = {"builtin": {"name": "constant", "width": 16}}
    context = context_of(store, request, sphere, sky)
    baked = run_until(store, request, context, "join")
    context["artefacts"]["transfer"] = {"digest": baked["join"][0]["transfer"]}
    compress = {"kind": "compress", "transfer": "job/transfer.h5", "settings": SMALL["compress"]}
    results = run_stages(REGISTRY.stages("compress", compress, context), store)
    (quantised,) = results["quantise"]
    (part,) = read_asset(store.local_path(quantised["asset"])).parts
    assert part.view_texture.shape[:2] == (256, 256)
    # measured 0.49 % of the radiance; stages state squares
    assert 4e-3**2 < quantised["errors"]["object view texture"] < 6e-3**2
    lost, texels = REGISTRY.finish("compress", compress, context, results).result["notes"]
    assert texels.startswith("object: the view texture of 256 x 256 texels is off by 0.")
    # four view ranks are asked for, of 24 terms that need nearly all
    error = results["compress"][0]["errors"]["object"]
    assert error > 0.1
    assert lost.startswith(f"object: clusters and ranks leave {error:.0%} of its transfer")


def test_validation_sees_the_texels_that_were_delivered(glossy_asset, store, tmp_path):
    _, context, results = glossy_asset
    (quantised,) = results["quantise"]
    assert 0.0 < quantised["errors"]["object view texture"] < 3e-3**2
    assert quantised["notes"] == []
    asset = read_asset(store.local_path(quantised["exact"]))
    glossy, receiver = asset.parts
    coarse = replace(glossy, view_texture=glossy.view_texture[::2, ::2].copy())
    write_asset(tmp_path / "coarse.h5", replace(asset, parts=(coarse, receiver)), bits=16)
    digest = store.put_file(tmp_path / "coarse.h5")
    environment = context["environment"]["canonical"]
    for texels, delivered in ((64, quantised["asset"]), (32, digest)):
        held = {**results, "quantise": [{**quantised, "asset": delivered}]}
        own, plain = validation_of(store, held, environment).parts
        assert own.view_texture.shape[:2] == (texels, texels)
        assert plain.view_texture is None


def test_the_same_request_gives_the_same_bytes(glossy_asset, tmp_path):
    from prtbake_storage.blobs.opening import open_store

    request, _, results = glossy_asset
    other = open_store((tmp_path / "blobs").as_uri())
    again = run_until(other, request, teapot_context(other, request, 3), "fit_light")
    assert again["join"][0]["transfer"] == results["join"][0]["transfer"]
    assert again["quantise"][0]["asset"] == results["quantise"][0]["asset"]
    assert again["fit_light"][0]["light"] == results["fit_light"][0]["light"]


def test_the_page_holds_its_pictures_and_loads_nothing(glossy_asset, store):
    files = {file.name: file.digest for file in finished(glossy_asset).artefacts}
    page = store.read_bytes(files["report.html"]).decode()
    # preview, two of the validation, and the plot of the steps beside the asset
    assert page.count("data:image/png;base64,") == 4
    assert "http://" not in page
    assert "https://" not in page


def test_the_stated_totals_are_those_of_the_pictures(glossy_asset, store):
    """The metrics compare the same two pictures, apart from the budget and without its variances.

    With v the squared difference of the means and r their reference's squared norm: total^2 +
    noise^2 = v / (r - variance), and relative L2^2 = v / r.
    """
    files = {file.name: file.digest for file in finished(glossy_asset).artefacts}
    written = json.loads(store.read_bytes(files["report.json"]))
    assert len(written["views"]) == 2
    for view in written["views"]:
        budget = view["budget"]
        squared = budget["total"] ** 2 + budget["total_noise"] ** 2
        expected = squared / (1.0 + budget["reference_noise"] ** 2)
        # float32 pictures
        assert view["metrics"]["relative_l2"] ** 2 == pytest.approx(expected, rel=1e-4)
        # negative twin: the noise is enough to tell
        assert budget["total"] ** 2 != pytest.approx(expected, rel=1e-4)


def test_lone_kinds_chain_to_the_same_asset(glossy_asset, store):
    """compress, render and validate on the artefacts of earlier jobs."""
    request, context, results = glossy_asset
    artefacts = {
        "transfer": {"digest": results["join"][0]["transfer"]},
        "asset": {"digest": results["quantise"][0]["asset"]},
        "light": {"digest": results["fit_light"][0]["light"]},
    }
    context = {**context, "artefacts": artefacts}
    compress = {
        "kind": "compress",
        "transfer": "job/transfer.h5",
        "settings": request["settings"]["compress"],
    }
    compressed = run_stages(REGISTRY.stages("compress", compress, context), store)
    # another cluster count for the receiver, so compare the object's factors
    assert compressed["compress"][0]["factors"] == results["compress"][0]["factors"]
    assert "report.json" in {
        file.name for file in REGISTRY.finish("compress", compress, context, compressed).artefacts
    }
    validate = {
        "kind": "validate", "asset": "job/asset.h5", "transfer": "job/transfer.h5",
        "light": "job/light.h5", "environment": request["environment"],
        "settings": request["settings"]["validation"],
    }  # fmt: skip
    validated = run_stages(REGISTRY.stages("validate", validate, context), store)
    assert len(validated["validate"]) == 2
    # without the asset before its quantisation one line holds what else are two
    alone = lines_of(validated)
    assert "compression" not in alone
    artefacts["exact"] = {"digest": results["quantise"][0]["exact"]}
    # the first camera is enough to compare
    validate["settings"] = {**validate["settings"], "cameras": [{"name": "front"}]}
    held = lines_of(run_stages(REGISTRY.stages("validate", validate, context), store))
    assert held == lines_of(results)
    merged = alone["compression and rounded factors"]
    apart = held["compression"], held["rounded factors"]
    assert apart[1] > 0.0
    assert abs(apart[0] - apart[1]) <= merged <= sum(apart)


def test_clustered_pca_stops_after_as_many_iterations_as_asked(glossy_asset, store):
    _, context, results = glossy_asset
    artefacts = {"transfer": {"digest": results["join"][0]["transfer"]}}
    found = {}
    for most in (1, 40):
        request = {
            "kind": "compress", "transfer": "job/transfer.h5",
            "settings": {"max_iterations": most, "n_clusters": 8},
        }  # fmt: skip
        stages = REGISTRY.stages("compress", request, {**context, "artefacts": artefacts})
        for part in run_stages(stages[:2], store)["compress"]:
            found[part["method"], most] = part["iterations"]
    assert found["cpca", 1] == 1
    # negative twin: left alone it goes on
    assert found["cpca", 40] > 1


def lines_of(results):
    """The budget of the first picture: error by line."""
    lines = results["validate"][0]["views"][0]["budget"]["lines"]
    return {line["name"]: line["error"] for line in lines}


@pytest.mark.parametrize(("name", "tessellation"), [("teapot", 4), ("icosphere", 2)])
def test_what_a_built_in_mesh_reports_is_what_is_stored(store, name, tessellation):
    found = registered(store, "mesh", builtin={"name": name, "tessellation": tessellation})
    stored = read_mesh(store.local_path(found["canonical"]))
    assert found["understood"]["n_vertices"] == len(stored.positions)
    assert found["understood"]["n_faces"] == len(stored.faces)
    # nothing was mended, so no job on it says so
    assert repairs(stored.report) == []


def test_a_piece_that_was_inside_out_is_said_to_be_turned_outward(store):
    """A tetrahedron wound inwards: the notes name what was done, once, and not its opposite."""
    inward = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 4 2\nf 1 3 4\nf 2 4 3\n"
    blob = store.put_bytes(inward.encode())
    found = registered(store, "mesh", blob=blob, format="obj")
    stored = read_mesh(store.local_path(found["canonical"]))
    corners = stored.positions[stored.faces]
    volume = np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    assert volume > 0.0
    assert [*repairs(stored.report), *stored.report["warnings"]] == [
        "mesh: 4 faces were turned over",
        "1 closed pieces were inside out and were turned outward",
    ]


@pytest.mark.parametrize(
    ("changes", "pointer"),
    [
        ({"settings": {"bake": {"bandwidth": 0.5}}}, None),
        ({"settings": {"bake": {"bandwidth": 5e4}}}, "/settings/bake/bandwidth"),
        ({"albedo_texture": "sha256:" + "0" * 64}, "/albedo_texture"),
        ({"tangents": "uv"}, "/tangents"),
    ],
)
def test_what_cannot_be_baked_is_refused_before_the_first_ray(store, changes, pointer):
    request = asset_request(**changes)
    context = teapot_context(store, request)
    stages = REGISTRY.stages("asset", request, context)
    with pytest.raises(SettingsError) as caught:
        run_stages(stages[:1], store)
    assert caught.value.pointer == pointer


def test_view_dependence_forced_off_bakes_one_term_and_says_what_that_costs(store):
    request = asset_request(receiver=None, effects={"view_dependence": "off"})
    results = run_until(store, request, teapot_context(store, request, 2), "quantise")
    planned = results["plan"][0]
    (decision,) = (e for e in planned["plan"]["effects"] if e["effect"] == "view_dependence")
    assert (decision["taken"], decision["forced"]) == (False, True)
    # the first of the published spectrum's figures, for Cook-Torrance m 0.5
    assert decision["predicted_error_otherwise"] == pytest.approx(0.051, abs=5e-4)
    assert planned["errors"]["object"] == pytest.approx(decision["predicted_error_otherwise"])
    with open_transfer(store.local_path(results["join"][0]["transfer"])) as transfer:
        assert transfer.header.parts[0].n_terms == 1
    asset = read_asset(store.local_path(results["quantise"][0]["asset"]))
    assert asset.parts[0].view_texture.shape[2] == 1
