"""The main job's stages, for real, in this process."""

import json
from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_storage.hdf5.writer import write_asset
from prtbake_workers.jobs.registry import REGISTRY
from support.local_stages import run_stages
from support.scenes import (
    SMALL,
    asset_request,
    context_of,
    run_asset,
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
    assert set(result["errors"]) == {"plan", "bake", "compress", "quantise", "fit_light"}
    assert all(0 <= error < 1 for stage in result["errors"].values() for error in stage.values())
    assert result["errors"]["bake"]["object"] > 0
    assert result["seconds"]["total"] > 0
    assert result["bytes"]["asset.h5"] < result["bytes"]["transfer.h5"]
    assert {effect["effect"] for effect in result["effects"]} >= {"self_shadowing"}


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


def test_every_stage_says_the_bytes_that_it_left(glossy_asset, store):
    _, _, results = glossy_asset
    (planned,), (quantised,), (rendered,) = (
        results[name] for name in ("plan", "quantise", "render")
    )
    left = {
        "plan": [planned["scene"], planned["projection"]],
        "bake": [tile["tile"] for tile in results["bake"]],
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
    assert min(stated.values()) > 0


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
    (note,) = REGISTRY.finish("compress", compress, context, results).result["notes"]
    assert note.startswith("object: the view texture of 256 x 256 texels is off by 0.")


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
    again = run_asset(other, request, teapot_context(other, request))
    assert again["join"][0]["transfer"] == results["join"][0]["transfer"]
    assert again["quantise"][0]["asset"] == results["quantise"][0]["asset"]
    assert again["fit_light"][0]["light"] == results["fit_light"][0]["light"]


def test_the_page_holds_its_pictures_and_loads_nothing(glossy_asset, store):
    files = {file.name: file.digest for file in finished(glossy_asset).artefacts}
    page = store.read_bytes(files["report.html"]).decode()
    assert page.count("data:image/png;base64,") == 3
    assert "http://" not in page
    assert "https://" not in page
    report = json.loads(store.read_bytes(files["report.json"]))
    assert report["budget"]["total"] <= report["budget"]["sum_of_lines"]


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
    held = lines_of(run_stages(REGISTRY.stages("validate", validate, context), store))
    assert held == lines_of(results)
    merged = alone["compression and 16-bit factors"]
    apart = held["compression"], held["16-bit factors"]
    assert apart[1] > 0.0
    assert abs(apart[0] - apart[1]) <= merged <= sum(apart)


def lines_of(results):
    """The budget of the first picture: error by line."""
    lines = results["validate"][0]["views"][0]["budget"]["lines"]
    return {line["name"]: line["error"] for line in lines}


def test_estimate_plans_without_running(glossy_asset, store):
    request, context, _ = glossy_asset
    quick = {"request": {"kind": "asset", **request}}
    results = run_stages(REGISTRY.stages("estimate", quick, context), store)
    estimate = REGISTRY.finish("estimate", quick, context, results).result
    assert estimate["total_seconds"] > 0
    assert estimate["plan"]["parts"][0]["n_terms"] > 1


@pytest.mark.parametrize(
    ("changes", "pointer"),
    [
        ({"settings": {"bake": {"bandwidth": 0.5}}}, None),
        ({"settings": {"compress": {"method": "cpca"}}}, "/settings/compress/method"),
        ({"albedo_texture": "sha256:" + "0" * 64}, "/albedo_texture"),
    ],
)
def test_what_cannot_be_baked_is_refused_before_the_first_ray(store, changes, pointer):
    request = asset_request(**changes)
    context = teapot_context(store, request)
    stages = REGISTRY.stages("asset", request, context)
    with pytest.raises(SettingsError) as caught:
        run_stages(stages[:1], store)
    assert caught.value.pointer == pointer
