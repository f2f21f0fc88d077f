import pytest

from prtbake_storage.contract.settings import AssetSettings
from prtbake_storage.errors import SettingsError
from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.effects import Decision
from prtbake_workers.planning.plan import make_plan
from prtbake_workers.planning.presets import resolve_stages

CHUNK = 32


def plan_of(settings, terms):
    scene = Scene.from_parts([sphere_mesh(3)])
    effects = [Decision("self_shadowing", True, False, "", {}),
               Decision("receiver_shadows", False, False, "", {})]  # fmt: skip
    return scene, make_plan(
        scene, ["object"], [terms], effects, settings, "medium",
        chunk_vertices=lambda *_: CHUNK, notes=[],
    )  # fmt: skip


@pytest.mark.parametrize("tile", [1, 100, 10_000, None])
def test_tiles_cover_every_vertex_once_in_whole_chunks(tile):
    settings = resolve_stages("medium", AssetSettings(bake={"tile_vertices": tile}))
    scene, plan = plan_of(settings, 16)
    tiles = plan.parts[0].tiles
    assert [start for start, _ in tiles] == [0, *(stop for _, stop in tiles[:-1])]
    assert tiles[-1][1] == scene.n_vertices
    assert all(start % CHUNK == 0 for start, _ in tiles)


def test_clustered_pca_refuses_more_than_one_term():
    settings = resolve_stages("medium", AssetSettings(compress={"method": "cpca"}))
    with pytest.raises(SettingsError, match="one term, this part has 4") as caught:
        plan_of(settings, 4)
    assert caught.value.pointer == "/settings/compress/method"


def test_predictions_grow_with_what_they_predict():
    low = plan_of(resolve_stages("low", AssetSettings()), 4)[1]
    high = plan_of(resolve_stages("high", AssetSettings()), 16)[1]
    assert high.parts[0].cost.bake_seconds > low.parts[0].cost.bake_seconds
    assert high.artefact_bytes["transfer.h5"] > low.artefact_bytes["transfer.h5"]
    assert high.peak_memory_bytes > low.peak_memory_bytes
