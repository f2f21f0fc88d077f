import numpy as np
import pytest

from prtbake_storage.contract.settings import AssetSettings, BakeSettings
from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.srbf import SrbfBasis, default_bandwidth
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning import plan as plan_module
from prtbake_workers.planning.decision import Decision
from prtbake_workers.planning.plan import MOST_BANDWIDTH, check_bandwidth, make_plan
from prtbake_workers.planning.presets import LADDER, resolve_stages
from prtbake_workers.transport.directions import cube_directions

CHUNK = 32


def plan_of(settings, terms, *, share=0.0, coloured=False):
    scene = Scene.from_parts([sphere_mesh(3)])
    effects = [
        Decision("self_shadowing", True, False, "", {}),
        Decision("receiver_shadows", False, False, "", {}),
        Decision("interreflection", share > 0.0, False, "",
                 {"first_bounce_share": share, "hit_share": 0.3, "variances": [share]}),
        Decision("colour_bleeding", coloured, False, "", {}),
    ]  # fmt: skip
    return scene, make_plan(
        scene, ["object"], [terms], effects, settings, "medium",
        roles=["object"], chunk_vertices=lambda *_: CHUNK, spectra=[np.ones(1)], notes=[],
    )  # fmt: skip


@pytest.mark.parametrize("tile", [1, 100, 10_000, None])
def test_tiles_cover_every_vertex_once_in_whole_chunks(tile):
    settings = resolve_stages("medium", AssetSettings(bake={"tile_vertices": tile}))
    scene, plan = plan_of(settings, 16)
    tiles = plan.parts[0].tiles
    assert [start for start, _ in tiles] == [0, *(stop for _, stop in tiles[:-1])]
    assert tiles[-1][1] == scene.n_vertices
    assert all(start % CHUNK == 0 for start, _ in tiles)


@pytest.mark.parametrize("method", ["vq", "pca", "cpca", "cta"])
def test_a_part_of_several_terms_is_compressed_as_asked(method):
    settings = resolve_stages("medium", AssetSettings(compress={"method": method}))
    part = plan_of(settings, 4)[1].parts[0]
    assert part.compression.method == method
    assert part.cost.factor_floats > 0
    # negative twin: left open it is a tensor
    assert plan_of(resolve_stages("medium", AssetSettings()), 4)[1].parts[0].compression.method == (
        "cta"
    )


def test_predictions_grow_with_what_they_predict():
    low = plan_of(resolve_stages("low", AssetSettings()), 4)[1]
    high = plan_of(resolve_stages("high", AssetSettings()), 16)[1]
    for stage, units in (("bake", ("rays", "flops", "samples")), ("compress", ("product_flops",))):
        assert all(high.work[stage][unit] > low.work[stage][unit] for unit in units)
    assert high.artefact_bytes["transfer.h5"] > low.artefact_bytes["transfer.h5"]
    assert high.peak_memory_bytes > low.peak_memory_bytes


def test_blocks_of_bounced_coefficients_cover_all_of_them_within_their_memory(monkeypatch):
    settings = resolve_stages("medium", AssetSettings())
    assert plan_of(settings, 4)[1].bounces is None
    # one where that is quick, as every block casts the rays anew
    assert len(plan_of(settings, 1, share=0.1)[1].bounces.blocks) == 1
    monkeypatch.setattr(plan_module, "BLOCK_BYTES", 4 << 20)
    for terms, coloured, least, quick in (
        (1, False, 1, 8.0),
        (1, False, 2, 0.0),
        (4, True, 5, 8.0),
    ):
        monkeypatch.setattr(plan_module, "TILE_SECONDS", quick)
        scene, plan = plan_of(settings, terms, share=0.1, coloured=coloured)
        blocks = plan.bounces.blocks
        assert blocks[0][0] == 0
        assert blocks[-1][1] == 642
        assert [start for start, _ in blocks[1:]] == [stop for _, stop in blocks[:-1]]
        assert len(blocks) >= least
        widest = max(stop - start for start, stop in blocks)
        assert 4 * scene.n_vertices * terms * (3 if coloured else 1) * (widest - 1) <= 4 << 20
        assert plan.work["bounces"]["rays"] > 0.0


def test_more_channels_mean_more_bytes_and_smaller_tiles():
    settings = resolve_stages("medium", AssetSettings())
    grey, coloured = (plan_of(settings, 4, share=0.1, coloured=c)[1] for c in (False, True))
    costs = [one.parts[0].cost.transfer_bytes for one in (grey, coloured)]
    assert costs[1] == 3 * costs[0]
    # three channels pack better than one
    assert 1.8 < coloured.artefact_bytes["transfer.h5"] / grey.artefact_bytes["transfer.h5"] < 3.0
    flops = "sparse_flops"
    assert coloured.work["bounces"][flops] == 3 * grey.work["bounces"][flops]


@pytest.mark.parametrize("threads", [1, 3])
def test_the_work_of_a_bake_is_that_of_its_tiles_added_up(threads):
    """As the report adds up what it measures: each tile costs a start, whatever runs beside it."""
    found = {}
    for tile in (CHUNK, 10_000):
        bake = {"tile_vertices": tile, "threads": threads}
        scene, plan = plan_of(resolve_stages("medium", AssetSettings(bake=bake)), 16)
        found[len(plan.parts[0].tiles)] = plan
    n_tiles = -(-scene.n_vertices // CHUNK)
    assert set(found) == {1, n_tiles}
    one, many = (found[count].work["bake"] for count in (1, n_tiles))
    assert (one["tasks"], many["tasks"]) == (1, n_tiles)
    assert many["tables"] == n_tiles * one["tables"]
    shared = {"rays", "flops", "samples", "values"}
    assert {unit: many[unit] for unit in shared} == {unit: one[unit] for unit in shared}
    alone = {"rays": 3 * 32**2 * scene.n_vertices / threads}
    assert one["rays"] == pytest.approx(alone["rays"], rel=1e-12)


@pytest.mark.parametrize("n_centres", [42, 162, 642])
def test_too_few_directions_for_the_basis_are_noted(n_centres):
    """Against the Gram matrix itself: 0.05 off the identity is where the note begins."""
    basis = SrbfBasis(icosphere({42: 1, 162: 2, 642: 3}[n_centres]))
    noted, defects = {}, {}
    for resolution in (3, 4, 5, 6, 8, 9, 10, 12, 15, 18, 24):
        cube = cube_directions(resolution)
        bake = {"n_centres": n_centres, "cube_resolution": resolution}
        _, plan = plan_of(resolve_stages("medium", AssetSettings(bake=bake)), 1)
        noted[resolution] = any("do not resolve" in note for note in plan.notes)
        defects[resolution] = basis.projection(cube.directions, cube.weights).gram_defect
    # a factor of two either way: the rule counts directions, the matrix weighs them
    assert all(noted[n] for n, defect in defects.items() if defect > 0.1)
    assert not any(noted[n] for n, defect in defects.items() if defect < 0.025)
    assert set(noted.values()) == {True, False}


@pytest.mark.parametrize("quality", LADDER)
def test_every_quality_resolves_its_basis(quality):
    assert plan_of(resolve_stages(quality, AssetSettings()), 1)[1].notes == ()


@pytest.mark.parametrize("n_centres", [12, 162, 642])
def test_a_bandwidth_that_leaves_holes_between_the_centres_is_refused(n_centres):
    most = MOST_BANDWIDTH * default_bandwidth(n_centres)
    check_bandwidth(BakeSettings(n_centres=n_centres))
    check_bandwidth(BakeSettings(n_centres=n_centres, bandwidth=most))
    with pytest.raises(SettingsError, match=f"at most {most:g}") as caught:
        check_bandwidth(BakeSettings(n_centres=n_centres, bandwidth=1.01 * most))
    assert caught.value.pointer == "/settings/bake/bandwidth"


def test_the_largest_bandwidth_is_where_holes_begin():
    """In the direction farthest from all centres every function is below a tenth of its peak."""
    centres = icosphere(3)
    directions = cube_directions(64).directions
    farthest = (directions @ centres.T).max(axis=1).min()
    lam = default_bandwidth(len(centres))
    assert np.exp(MOST_BANDWIDTH * lam * (farthest - 1.0)) < 0.1
    # at the default it is no hole
    assert np.exp(lam * (farthest - 1.0)) > 0.7
