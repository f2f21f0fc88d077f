import json
from dataclasses import asdict
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from prtbake_storage.contract.settings import AssetSettings, BakeSettings, CompressSettings
from prtbake_storage.errors import SettingsError
from prtbake_workers.planning.presets import (
    LADDER,
    PartCompression,
    PlannedBake,
    resolve_compression,
    resolve_stages,
)


def test_every_step_of_the_ladder_resolves_and_grows():
    steps = [resolve_stages(quality, AssetSettings()) for quality in LADDER]
    for lower, upper in pairwise(steps):
        assert lower.bake.cube_resolution <= upper.bake.cube_resolution
        assert lower.bake.term_energy_lost > upper.bake.term_energy_lost
        assert lower.bake.projection_tolerance > upper.bake.projection_tolerance
        assert lower.fit_light.n_lobes < upper.fit_light.n_lobes


def test_medium_holds_the_paper_s_settings_but_for_its_rays():
    """Sections 5.1 and 7: 6 x 32 x 32 texels, 642 SRBFs, ranks (8, 48, 24), 16 rays a texel."""
    medium = resolve_stages("medium", AssetSettings()).bake
    assert (medium.cube_resolution, medium.n_centres) == (32, 642)
    holding = [name for name, step in LADDER.items() if step.ranks == (8, 48, 24)]
    assert holding == ["medium"]
    rays = {name: resolve_stages(name, AssetSettings()).bake.supersample for name in LADDER}
    assert (rays["medium"], rays["high"], rays["reference"]) == (1, 2, 2)
    assert max(rays.values()) < 4


def test_a_quality_and_overrides_that_ask_too_much_together_are_refused():
    """Neither the request nor the quality is too much by itself."""
    size = {"width": 1024, "height": 1024, "rotations_deg": [(0.0, 0.0, 0.0)] * 2}
    assert resolve_stages("medium", AssetSettings(validation=size)).validation.passes == 8
    with pytest.raises(SettingsError, match="passes x rotations is 67108864") as caught:
        resolve_stages("reference", AssetSettings(validation=size))
    assert caught.value.pointer == "/settings/validation/rotations_deg"


def test_overrides_replace_only_the_fields_given():
    plain = resolve_stages("medium", AssetSettings())
    changed = resolve_stages("medium", AssetSettings(bake={"n_centres": 162}))
    assert changed.bake.n_centres == 162
    assert changed.bake.cube_resolution == plain.bake.cube_resolution
    assert changed.compress == plain.compress


def test_a_light_of_another_method_leaves_the_lobes_of_the_quality():
    step = resolve_stages("low", AssetSettings(fit_light={"max_iterations": None})).fit_light
    assert (step.n_lobes, step.max_iterations) == (64, 3)
    other = resolve_stages("low", AssetSettings(fit_light={"method": "sh"})).fit_light
    assert (other.sh_order, other.n_lobes, other.max_iterations) == (18, None, None)
    target = resolve_stages("low", AssetSettings(fit_light={"max_error": 0.02})).fit_light
    assert (target.n_lobes, target.max_iterations) == (642, 3)
    both = {"max_error": 0.02, "n_lobes": 50}
    assert resolve_stages("low", AssetSettings(fit_light=both)).fit_light.n_lobes == 50


def test_numbers_left_open_are_told_from_those_that_a_quality_sets():
    plain = resolve_stages("draft", AssetSettings())
    assert (plain.planned_bake.cube_resolution, plain.planned_bake.n_centres) == (16, 162)
    assert plain.planned_bake.model_dump() == plain.bake.model_dump()
    for name in ("cube_resolution", "n_centres"):
        left = resolve_stages("draft", AssetSettings(bake={name: "auto"}))
        assert left.bake.open_numbers == (name,)
        assert left.bake.projection_tolerance == plain.bake.projection_tolerance
        with pytest.raises(ValidationError, match=name):
            left.planned_bake  # noqa: B018


def test_a_given_number_of_terms_takes_the_place_of_the_energy():
    settings = resolve_stages("medium", AssetSettings(bake={"n_terms": 16}))
    assert settings.bake.n_terms == 16
    assert settings.bake.term_energy_lost is None


@pytest.mark.parametrize(
    ("stage", "fields"),
    [
        ("bake", {"n_centres": 100}),
        ("bake", {"nonsense": 1}),
        ("bake", {"projection_tolerance": 0.0}),
        ("bake", {"n_centres": "auto", "bandwidth": 60.0}),
        ("bake", {"n_centres": 10242, "cube_resolution": "auto"}),
        ("bake", {"frame_seed": -1}),  # numpy's generators refuse it
        ("bake", {"frame_seed": 2**63}),  # more than a file's integers hold
        ("compress", {"ranks": [0, 1, 1]}),
        ("compress", {"ranks": [1, 1, 10**400]}),  # more than a float holds: costs are floats
    ],
)
def test_illegal_overrides_are_refused_at_submission(stage, fields):
    with pytest.raises(ValidationError, match=stage):
        AssetSettings(**{stage: fields})


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"n_centres": "auto", "bandwidth": 60.0}, "a bandwidth goes with a number of n_centres"),
        ({"n_centres": 10242, "cube_resolution": "auto"}, "10242 centres need a cube_resolution"),
    ],
)
def test_what_planning_cannot_choose_the_rest_for_says_what_is_missing(fields, words):
    with pytest.raises(ValidationError, match=words):
        BakeSettings.model_validate(fields)
    # twins: both open without, both given, and the centres alone
    BakeSettings(n_centres="auto", cube_resolution="auto")
    BakeSettings(n_centres=642, bandwidth=60.0, cube_resolution="auto")
    BakeSettings(n_centres=10242, cube_resolution=66)


def test_compression_follows_the_number_of_terms_and_vertices():
    glossy = resolve_compression(
        CompressSettings(), "medium", n_verts=34_834, n_terms=16, n_coeffs=642
    )
    assert (glossy.method, glossy.n_clusters, glossy.ranks) == ("cta", 97, (8, 48, 24))
    diffuse = resolve_compression(CompressSettings(), "medium", n_verts=10, n_terms=1, n_coeffs=12)
    assert diffuse.method == "cpca"
    assert diffuse.n_clusters >= 1
    assert diffuse.n_components == 12


def test_components_are_cut_to_the_coefficients_of_all_channels():
    for n_channels, expected in ((1, 4), (3, 12)):
        found = resolve_compression(
            CompressSettings(), "medium", n_verts=900, n_terms=1, n_coeffs=4, n_channels=n_channels
        )
        assert found.n_components == expected
    glossy = resolve_compression(
        CompressSettings(), "medium", n_verts=900, n_terms=3, n_coeffs=42, n_channels=3
    )
    # the view rank is that of each channel
    assert glossy.ranks == (3, 42, 24)
    several = resolve_compression(
        CompressSettings(method="cpca"), "medium", n_verts=900, n_terms=3, n_coeffs=4
    )
    assert several.n_components == 12


def test_methods_keep_about_as_many_vectors():
    """VQ a mean for every mean and component of clustered PCA; PCA 2.5 times a cluster's."""
    size = {"n_verts": 34_834, "n_terms": 16, "n_coeffs": 642}

    def found(method, **given):
        settings = CompressSettings(method=method, **given)
        return resolve_compression(settings, "medium", **size)

    cpca, vq, pca = (found(method) for method in ("cpca", "vq", "pca"))
    assert (cpca.n_clusters, cpca.n_components) == (97, 16)
    assert (vq.n_clusters, vq.n_components) == (97 * 17, 0)
    assert (pca.n_clusters, pca.n_components) == (1, 40)
    # what is asked for is taken, and what a method has no use for left aside
    given = {"n_clusters": 300, "n_components": 5}
    assert (found("vq", **given).n_clusters, found("vq", **given).n_components) == (300, 0)
    assert (found("pca", **given).n_clusters, found("pca", **given).n_components) == (1, 5)
    large = resolve_compression(
        CompressSettings(method="vq"), "reference", n_verts=400_000, n_terms=1, n_coeffs=2562
    )
    assert large.n_clusters == 4096
    few = resolve_compression(
        CompressSettings(method="vq"), "medium", n_verts=7, n_terms=2, n_coeffs=9
    )
    assert few.n_clusters == 7


def test_a_compression_comes_back_from_json():
    found = resolve_compression(
        CompressSettings(), "draft", n_verts=900, n_terms=3, n_coeffs=42, n_channels=3
    )
    assert PartCompression.from_dict(json.loads(json.dumps(asdict(found)))) == found


def test_ranks_and_clusters_are_cut_to_what_the_data_holds():
    settings = CompressSettings(n_clusters=100, ranks=(8, 48, 24))
    cut = resolve_compression(settings, "medium", n_verts=7, n_terms=3, n_coeffs=12)
    assert cut.n_clusters == 7
    assert cut.ranks == (3, 12, 24)


def test_a_sharp_brdf_gets_the_view_columns_that_it_needs():
    """The chosen rank leaves no more than asked; one less would."""
    spectrum = 0.9 ** np.arange(100)
    energy = spectrum**2

    def left(rank):
        return energy[rank:].sum() / energy.sum()

    found = {}
    for quality in ("draft", "medium"):
        compression = resolve_compression(
            CompressSettings(), quality, n_verts=1000, n_terms=60, n_coeffs=162,
            singular_values=spectrum,
        )  # fmt: skip
        found[quality] = compression.ranks[0]
        asked = 2.0 * LADDER[quality].bake["term_energy_lost"]
        assert left(found[quality]) <= asked < left(found[quality] - 1)
        growth = (found[quality] / LADDER[quality].ranks[0]) ** 0.5
        assert compression.ranks[1] == min(162, round(LADDER[quality].ranks[1] * growth))
        assert compression.ranks[2] == round(LADDER[quality].ranks[2] * growth)
    assert LADDER["draft"].ranks[0] < found["draft"] < found["medium"]
    # what is asked for is taken as it is, a smooth BRDF keeps the ladder's, memory bounds the rest
    given = CompressSettings(ranks=(3, 8, 8))
    common = {"n_terms": 60, "n_coeffs": 162}
    assert resolve_compression(
        given, "draft", n_verts=1000, singular_values=spectrum, **common
    ).ranks == (3, 8, 8)
    smooth = resolve_compression(
        CompressSettings(), "draft", n_verts=1000, singular_values=0.1 ** np.arange(9.0), **common
    )
    assert smooth.ranks[0] == LADDER["draft"].ranks[0]
    large = resolve_compression(
        CompressSettings(), "draft", n_verts=300_000, singular_values=spectrum, **common
    )
    assert large.ranks[0] == max(LADDER["draft"].ranks[0], (1 << 30) // (4 * 162 * 300_000))


def test_a_black_brdf_needs_no_more_view_columns_than_the_ladder_gives():
    found = resolve_compression(
        CompressSettings(), "medium", n_verts=100, n_terms=16, n_coeffs=162,
        singular_values=np.zeros(16),
    )  # fmt: skip
    assert found.ranks == LADDER["medium"].ranks


def test_a_basis_settles_its_own_size_and_refuses_the_other_s_fields():
    assert (BakeSettings().n_centres, BakeSettings().sh_order) == (642, None)
    assert PlannedBake(n_centres=None).n_coeffs == 642
    harmonics = BakeSettings(basis="sh")
    assert (harmonics.n_centres, harmonics.bandwidth, harmonics.sh_order) == (None, None, 25)
    assert PlannedBake(basis="sh").n_coeffs == 625
    assert PlannedBake(basis="sh", sh_order=5).n_coeffs == 25
    # what tasks are given as JSON is read back as it was
    for settings in (harmonics, BakeSettings(n_centres=42, bandwidth=4.0)):
        assert BakeSettings.model_validate(settings.model_dump(mode="json")) == settings


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"basis": "sh", "n_centres": 642}, "n_centres is of basis 'srbf', not of 'sh'"),
        ({"basis": "sh", "bandwidth": 60.0}, "bandwidth is of basis 'srbf'"),
        ({"sh_order": 5}, "sh_order is of basis 'sh', not of 'srbf'"),
        ({"basis": "sh", "sh_order": 101}, "sh_order"),
        ({"basis": "haar"}, "basis"),
        ({"basis": "sh", "n_centres": "auto"}, "n_centres is of basis 'srbf'"),
        ({"basis": "sh", "cube_resolution": "auto"}, "not with auto"),
        ({"factorisation": "sh", "n_terms": 8}, "n_terms is of factorisation 'svd', not of 'sh'"),
        ({"factorisation": "sh", "term_energy_lost": 0.1}, "term_energy_lost is of factorisation"),
        ({"view_order": 5}, "view_order is of factorisation 'sh', not of 'svd'"),
        ({"factorisation": "sh", "view_order": 11}, "view_order"),
    ],
)
def test_a_field_of_the_other_kind_is_named(fields, named):
    with pytest.raises(ValidationError, match=named) as refused:
        AssetSettings(bake=fields)
    assert "bake" in refused.value.errors()[0]["loc"]


@pytest.mark.parametrize(("quality", "order"), [("draft", 12), ("medium", 25), ("reference", 50)])
def test_a_quality_gives_harmonics_about_as_many_coefficients(quality, order):
    bake = resolve_stages(quality, AssetSettings(bake={"basis": "sh"})).planned_bake
    assert (bake.n_centres, bake.sh_order) == (None, order)
    assert bake.n_coeffs <= resolve_stages(quality, AssetSettings()).planned_bake.n_coeffs
    own = resolve_stages(quality, AssetSettings(bake={"basis": "sh", "sh_order": 4})).planned_bake
    assert own.n_coeffs == 16


def test_views_in_harmonics_take_the_place_of_terms():
    for quality in LADDER:
        bake = resolve_stages(quality, AssetSettings(bake={"factorisation": "sh"})).bake
        assert (bake.n_terms, bake.term_energy_lost, bake.view_order) == (None, None, 5)
        assert resolve_stages(quality, AssetSettings()).bake.view_order is None


@pytest.mark.parametrize(
    ("fields", "name"),
    [
        ({"n_centres": None}, "n_centres"),
        ({"basis": "sh", "sh_order": None}, "sh_order"),
        ({"n_terms": None}, "term_energy_lost"),
        ({"term_energy_lost": None}, "term_energy_lost"),
    ],
)
def test_null_leaves_a_field_to_the_quality(fields, name):
    without = {key: value for key, value in fields.items() if value is not None}
    expected, found = (
        getattr(resolve_stages("draft", AssetSettings(bake=bake)).bake, name)
        for bake in (without, fields)
    )
    assert found == expected
    # and not to what a bake by itself would take
    assert found != getattr(BakeSettings.model_validate(fields), name)
