"""Subsurface scattering through the stages of a job: what is decided, stored and said."""

import numpy as np
import pytest

from prtbake_storage.blobs.opening import open_store
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.bounces import read_transfer_tile
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_storage.queue.context import TaskContext
from prtbake_workers.jobs import bounce, scattering
from prtbake_workers.jobs.estimate import estimate
from prtbake_workers.jobs.media import make_dipole
from prtbake_workers.jobs.report import gather
from prtbake_workers.jobs.scattering import grouped_rows, read_rows, run_rows
from prtbake_workers.jobs.scene_file import read_scene
from prtbake_workers.planning import scattering_cost
from prtbake_workers.planning.cluster_limit import CLUSTER_SHARE
from prtbake_workers.transport.part_scattering import MEASURED_ROWS
from prtbake_workers.transport.subsurface import SubsurfaceOperator
from support.scenes import asset_request, context_of, run_asset, run_until, teapot_context
from support.task_child import run_child

TINT = [0.9, 0.5, 0.8]
WHITE = {"model": "lambert", "albedo": TINT}
MARBLE = {"medium": "marble", "mm_per_unit": 2.0}
BAKE = {"cube_resolution": 8, "n_centres": 42, "bounce_rays": 16, "max_bounces": 3}
ALONE = {"interreflection": "off"}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return open_store((tmp_path_factory.mktemp("scattering") / "blobs").as_uri())


def joined(store, **changes):
    given = {"brdf": WHITE, "subsurface": MARBLE, "settings": {"bake": BAKE}} | changes
    request = asset_request(**given)
    return run_until(store, request, teapot_context(store, request), "join")


@pytest.fixture(scope="module")
def scattered(store):
    return joined(store, effects=ALONE)


def direct_of(store, results):
    """Direct transfer of every part, (verts, coeffs)."""
    return [
        np.concatenate([read_transfer_tile(store.local_path(tile))[0][:, 0] for tile in tiles])
        for tiles in bounce.grouped_tiles(results, "bake")
    ]


def stored(store, results):
    with open_transfer(store.local_path(results["join"][0]["transfer"])) as transfer:
        header = transfer.header
        return header, [
            transfer.read(index).reshape(part.n_vertices, part.n_channels, -1)
            for index, part in enumerate(header.parts)
        ]


def decision_of(results):
    (found,) = (
        one
        for one in results["plan"][0]["plan"]["effects"]
        if one["effect"] == "subsurface_scattering"
    )
    return found


def assert_within_its_share(error, results):
    """What clusters cost is a tenth of the tolerance at most, as a few vertices tell it."""
    evidence = decision_of(results)["evidence"]
    (limit,) = evidence["clusters"]
    assert limit["error"] <= CLUSTER_SHARE * evidence["tolerance"]
    assert 0.3 * limit["error"] < error < 2.0 * limit["error"]


def test_the_object_is_scattered_and_the_plane_is_not(store, scattered):
    assert decision_of(scattered)["taken"]
    scene = read_scene(store.local_path(scattered["plan"][0]["scene"])).scene
    direct = direct_of(store, scattered)
    (angle,) = scattered["plan"][0]["plan"]["bounces"]["solid_angles"]
    operator = SubsurfaceOperator(scene.part(0), make_dipole(MARBLE), max_solid_angle=angle)
    expected = operator.apply(direct[0]).transfer
    header, found = stored(store, scattered)
    assert [part.n_channels for part in header.parts] == [3, 3]
    assert header.parts[0].subsurface == MARBLE
    assert header.parts[1].subsurface is None
    assert header.provenance["scattering"] == [0]
    assert header.provenance["interreflection"] is None
    # 16 bits twice: half a step of either row
    largest = np.abs(expected).max()
    np.testing.assert_allclose(found[0].transpose(1, 0, 2), expected, atol=4e-5 * largest)
    for channel in range(3):
        np.testing.assert_allclose(found[1][:, channel], direct[1], atol=1e-4 * direct[1].max())
    # the tint multiplies all of that at the end
    np.testing.assert_allclose(header.parts[0].albedo, TINT, rtol=1e-6)
    # negative twin: light that leaves where it falls
    there = make_dipole(MARBLE).diffuse_albedo[:, None, None] * direct[0]
    assert np.abs(there - expected).max() > 0.1 * largest


@pytest.fixture(scope="module")
def again(store):
    """The same bake once more, and how many rows its stages built."""
    built, stage = {"scattering": 0, "bounces": 0}, "scattering"
    build, run_block = SubsurfaceOperator.block, bounce.run_block

    def counted(self, rows, **options):
        # what the error is measured against integrates every triangle
        built[stage] += len(rows) if self.max_solid_angle else 0
        return build(self, rows, **options)

    def blocks(args, context):
        nonlocal stage
        stage = "bounces"
        return run_block(args, context)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bounce, "run_block", blocks)
        patch.setattr(SubsurfaceOperator, "block", counted)
        return joined(store, effects=ALONE), built


def test_rows_are_built_once_for_all_blocks(again):
    """In every stage but the rows' own, only rows of the few vertices that are measured."""
    results, built = again
    first, last = results["plan"][0]["plan"]["parts"][0]["vertex_range"]
    assert len(results["bounces"]) == 2
    assert built["scattering"] == last - first
    assert 0 < built["bounces"] <= 2 * MEASURED_ROWS


def rows_of(store, results):
    return [read_rows(store.local_path(digest)) for digest in grouped_rows(results)[0]]


def test_the_same_rows_come_from_any_runs_and_the_same_files_again(
    store, scattered, again, monkeypatch
):
    for name in ("scattering", "bounces", "join"):
        assert again[0][name] == scattered[name]
    (whole,) = rows_of(store, scattered)
    monkeypatch.setattr(scattering_cost, "ROWS_PER_TASK", 200)
    parted = joined(store, effects=ALONE)
    runs = rows_of(store, parted)
    assert [one.start for one in runs] == [0, 177, 353]
    for name in ("columns", "values"):
        joint = np.concatenate([getattr(one, name) for one in runs], axis=-1)
        # a row depends on its vertex alone, up to the last bit of a float32
        np.testing.assert_allclose(joint, getattr(whole, name), rtol=3e-7)
    assert sum(one.n_clusters for one in runs) == whole.n_clusters
    _, (one, _) = stored(store, scattered)
    _, (other, _) = stored(store, parted)
    np.testing.assert_allclose(other, one, atol=4e-5 * np.abs(one).max())
    # in a process of its own a run comes out as in this one
    assert run_child(scattering.stage().tasks(parted)[1], store).result == parted["scattering"][1]
    # negative twin: other runs are other files
    assert parted["scattering"][0] != scattered["scattering"][0]


def test_progress_is_told_while_rows_are_built(store, scattered):
    messages = []
    args = {"scene": scattered["plan"][0]["scene"], "part": 0, "start": 0, "stop": 530}
    with store.scratch() as scratch:
        found = run_rows(args, TaskContext(store, scratch, messages.append))
    assert found == scattered["scattering"][0]
    told = [message["progress"] for message in messages]
    assert told[-1] == [530.0, 530.0, "vertices"]
    assert told[0][0] < 530.0


def test_left_out_it_is_the_albedo_of_the_medium(store, scattered):
    off = joined(store, effects=ALONE | {"subsurface_scattering": "off"})
    assert off["scattering"] == off["bounces"] == off["add_bounces"] == []
    header, found = stored(store, off)
    assert header.parts[0].n_channels == 1
    assert header.parts[0].subsurface == MARBLE
    assert header.provenance["scattering"] == []
    albedo = make_dipole(MARBLE).diffuse_albedo
    np.testing.assert_allclose(header.parts[0].albedo, TINT * albedo, rtol=1e-6)
    # what the probe foresaw is what the two assets differ by
    header, with_it = stored(store, scattered)
    areas = header.parts[0].areas
    leaving = albedo[:, None] * found[0]
    wrong = ((leaving - with_it[0]) ** 2).sum(axis=(1, 2))
    share = float(areas @ wrong) / float(areas @ (with_it[0] ** 2).sum(axis=(1, 2)))
    for results in (off, scattered):
        foreseen = decision_of(results)["predicted_error_otherwise"]
        # bands 0 to 4 stand for all, and points of the facets for the vertices
        assert 0.5 * share < foreseen < 2.0 * share
    assert share > 0.05


def test_a_path_far_below_the_sampling_distance_is_left(store):
    fine = joined(store, subsurface=MARBLE | {"mm_per_unit": 1e6}, effects=ALONE)
    decided = decision_of(fine)
    assert not decided["taken"]
    assert decided["predicted_error_otherwise"] < 1e-3
    on = joined(
        store,
        subsurface=MARBLE | {"mm_per_unit": 1e6},
        effects=ALONE | {"subsurface_scattering": "on"},
    )
    assert any("far apart" in note for note in gather("x", on)["bounce_notes"])
    assert all(np.isfinite(one).all() for one in stored(store, on)[1])


def test_a_white_medium_with_a_path_far_beyond_the_object_is_handled(store):
    """Light gets lost in the half-space that the dipole stands for: little comes back, evenly."""
    vast = {"scattering": 1.0, "absorption": 0.0, "mm_per_unit": 1e-6}
    results = joined(store, subsurface=vast, effects=ALONE)
    assert decision_of(results)["taken"]
    _, found = stored(store, results)
    assert all(np.isfinite(one).all() for one in found)
    largest = np.abs(found[0]).max()
    assert 0.0 < largest < 1e-9
    # every vertex gives back the same
    assert np.ptp(found[0], axis=0).max() < 1e-3 * largest


def test_bounces_meet_the_scattered_light(store, scattered):
    """Both effects: the plane gets light in the medium's colours, tinted by what the object is."""
    effects = {"interreflection": "on", "colour_bleeding": "on"}
    both = joined(store, brdf=WHITE | {"albedo": 1.0}, effects=effects)
    _, alone = stored(store, scattered)
    _, found = stored(store, both)
    gains = [(one**2).sum(axis=(0, 2)) / (two**2).sum(axis=(0, 2))
             for one, two in zip(found, alone, strict=True)]  # fmt: skip
    assert all((gain > 1.0).all() for gain in gains)
    # of what falls on it marble sends more red than blue
    assert gains[1][0] > gains[1][2]
    account = gather("x", both)
    (stage,) = (one for one in account["stages"] if one["name"] == "bounces")
    assert_within_its_share(stage["errors"]["object scattering"], both)
    assert "receiver scattering" not in stage["errors"]
    assert account["bounces"]["left_out_is"] == "a bound"


def test_the_report_says_what_was_scattered(scattered):
    account = gather("x", scattered)
    (stage,) = (one for one in account["stages"] if one["name"] == "bounces")
    assert sorted(stage["errors"]) == ["object 16-bit", "object scattering", "receiver 16-bit"]
    assert account["bounces"] is None
    (note,) = account["bounce_notes"]
    dipole = make_dipole(MARBLE)
    assert f"mean free path {dipole.mean_free_path[0]:.3g}" in note
    assert f"gives back {dipole.diffuse_albedo[0]:.3g}" in note
    plan = scattered["plan"][0]["plan"]
    assert all(plan["work"]["scattering"].values())
    # no rays: nothing bounces
    assert plan["work"]["bounces"]["sparse_flops"] > 0.0 == plan["work"]["bounces"]["rays"]
    assert all(plan["memory_bytes"][name] > 0 for name in ("scattering", "bounces"))


@pytest.fixture(scope="module")
def marble_on_a_plane(store):
    """A whole job: request, context, results."""
    request = asset_request(
        brdf=WHITE,
        subsurface=MARBLE,
        receiver={"resolution": 16, "albedo": 0.5},
        settings={
            "bake": {"bounce_rays": 32, "max_bounces": 3},
            "compress": {"n_components": 32},
            "fit_light": {"n_lobes": 42},
            "validation": {
                "width": 40, "height": 30, "passes": 6, "samples": 32, "bounce_samples": 48,
                "cameras": [{"name": "front"}],
            },
        },
    )  # fmt: skip
    context = context_of(
        store,
        request,
        {"builtin": {"name": "icosphere", "tessellation": 2}},
        {"builtin": {"name": "sun_sky", "width": 64}},
    )
    return request, context, run_asset(store, request, context)


def test_a_job_of_marble_on_a_plane(marble_on_a_plane):
    _, _, results = marble_on_a_plane
    decided = decision_of(results)
    assert decided["taken"]
    assert not decided["forced"]
    (written,) = results["report"]
    report = written["report"]
    budget = report["budget"]
    lines = {line["name"]: line for line in budget["lines"]}
    stored = lines["scattering, bounces and 16-bit transfer"]
    # the plane alone has errors in the lines before; the ball has all of its own here
    assert stored["error"] < 0.05
    assert stored["noise"] < 0.06
    sum_of_lines = sum(line["error"] + line["noise"] for line in lines.values())
    assert budget["total"] < sum_of_lines
    # 162 SRBFs and a plane of 16 vertices a side
    assert budget["total"] < 0.15
    assert any("object scatters light inside" in note for note in report["notes"])
    assert_within_its_share(report["errors"]["bounces"]["object scattering"], results)


def test_an_estimate_foresees_the_job(store, marble_on_a_plane):
    request, context, results = marble_on_a_plane
    args = {"request": request | {"kind": "asset"}, "context": context}
    with store.scratch() as scratch:
        found = estimate(args, TaskContext(store, scratch, lambda _: None))
    assert found["plan"]["bounces"]["scattering"] == [0]
    assert found["plan"]["bounces"] == results["plan"][0]["plan"]["bounces"]
    plain = {"request": args["request"] | {"subsurface": None}, "context": context}
    with store.scratch() as scratch:
        without = estimate(plain, TaskContext(store, scratch, lambda _: None))
    for stage in ("bounces", "validate"):
        assert found["seconds"][stage] > without["seconds"][stage]
    assert found["seconds"]["scattering"] > 0.0
    assert "scattering" not in without["seconds"]


def test_a_grey_medium_needs_one_channel(store):
    grey = {"scattering": 3.0, "absorption": 0.02, "mm_per_unit": 2.0}
    results = joined(store, subsurface=grey, effects=ALONE)
    assert decision_of(results)["taken"]
    header, _ = stored(store, results)
    assert [part.n_channels for part in header.parts] == [1, 1]


def test_a_glossy_brdf_is_refused(store):
    with pytest.raises(SettingsError, match="lambert") as caught:
        joined(store, brdf={"model": "phong", "kd": 0.5, "ks": 0.2, "exponent": 4})
    assert caught.value.pointer == "/subsurface"
