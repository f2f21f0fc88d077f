"""Interreflection through the stages of a job: what is stored, what it costs, what is said."""

import numpy as np
import pytest

from prtbake_storage.blobs.opening import open_store
from prtbake_storage.hdf5.bounces import read_transfer_tile
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs import bounce
from prtbake_workers.jobs.report import gather
from prtbake_workers.jobs.scene_file import read_scene
from prtbake_workers.report.account import make_report
from prtbake_workers.report.html import report_page
from prtbake_workers.transport.bounce_operator import build_bounce_block
from prtbake_workers.transport.interreflection import bounce_series
from support.bounce_scenes import opaque
from support.scenes import asset_request, run_until, teapot_context

RED = {"model": "lambert", "albedo": [0.9, 0.2, 0.1]}
BAKE = {"n_centres": 42, "bounce_rays": 16, "max_bounces": 4, "bounce_tolerance": 0.0}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return open_store((tmp_path_factory.mktemp("bounces") / "blobs").as_uri())


def joined(store, **changes):
    request = asset_request(**{"brdf": RED, "settings": {"bake": BAKE}} | changes)
    return run_until(store, request, teapot_context(store, request), "join")


@pytest.fixture(scope="module")
def coloured(store):
    effects = {"interreflection": "on", "colour_bleeding": "on"}
    return joined(store, effects=effects)


def stored(store, results):
    """Coefficients of every part as they are stored, (verts, channels, coeffs)."""
    with open_transfer(store.local_path(results["join"][0]["transfer"])) as transfer:
        return transfer.header, [
            transfer.read(index).reshape(part.n_vertices, part.n_channels, -1)
            for index, part in enumerate(transfer.header.parts)
        ]


def test_stored_transfer_is_the_series_of_the_sparse_operator(store, coloured):
    planned = read_scene(store.local_path(coloured["plan"][0]["scene"]))
    direct = np.concatenate(
        [
            read_transfer_tile(store.local_path(tile))[0][:, 0]
            for tiles in bounce.grouped_tiles(coloured, "bake")
            for tile in tiles
        ]
    )
    surface = opaque(planned.scene)
    operator = build_bounce_block(
        surface, (0, planned.scene.n_vertices), albedo=planned.reflection()[1], n_rays=16, seed=0
    )
    expected = bounce_series(
        direct, operator.matrices, areas=planned.scene.areas, tolerance=0.0, max_bounces=4
    ).transfer
    header, found = stored(store, coloured)
    assert [part.n_channels for part in header.parts] == [3, 3]
    found = np.concatenate(found).transpose(1, 0, 2)
    # 16 bits twice: half a step of either row, 1/65534 of its largest
    np.testing.assert_allclose(found, expected, atol=4e-5 * np.abs(expected).max())
    # the colours differ, and from the direct light, by far more than that
    assert np.abs(found[0] - found[2]).max() > 0.01 * np.abs(expected).max()
    assert np.abs(found[2] - direct).max() > 1e-3 * np.abs(expected).max()


def test_energies_are_those_of_what_is_stored(store, coloured):
    with open_transfer(store.local_path(coloured["join"][0]["transfer"])) as transfer:
        for index, part in enumerate(transfer.header.parts):
            energies = transfer.energies(index)
            kept = (transfer.read(index).astype(np.float64) ** 2).sum(axis=(1, 2))
            # of direct light, which is projected; bounced light is in the basis from the start
            np.testing.assert_allclose(
                energies.signal - energies.residual, kept, rtol=0.02, atol=1e-6
            )
            assert part.n_channels == 3


def test_one_channel_holds_the_mean_of_the_colours(store):
    grey = joined(store, effects={"interreflection": "on", "colour_bleeding": "off"})
    header, found = stored(store, grey)
    assert [part.n_channels for part in header.parts] == [1, 1]
    mean = joined(
        store,
        brdf=RED | {"albedo": 0.4},  # the mean of 0.9, 0.2 and 0.1
        effects={"interreflection": "on", "colour_bleeding": "off"},
    )
    for one, other in zip(found, stored(store, mean)[1], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4 * np.abs(other).max())


def test_bounces_forced_off_leave_the_bake_as_it_is(store, coloured):
    off = joined(store, effects={"interreflection": "off"})
    assert off["bounces"] == off["add_bounces"] == []
    assert [tile["tile"] for tile in off["bake"]] != []
    _, direct = stored(store, off)
    _, bounced = stored(store, coloured)
    assert all(one.shape[1] == 1 for one in direct)
    # light is only added: every part is brighter, the red of the pot more than its blue
    gains = [(b**2).sum(axis=(0, 2)) / (d**2).sum() for b, d in zip(bounced, direct, strict=True)]
    assert all((gain > 1.0001).all() for gain in gains)
    assert gains[0][0] > gains[0][2]


def test_the_report_tells_what_each_bounce_added(coloured):
    account = gather("x", coloured)
    assert account["bounces"]["bounces"] == 4
    assert account["bounces"]["channels"] == 3
    assert account["bounces"]["left_out_is"] == "a bound"
    (stage,) = (one for one in account["stages"] if one["name"] == "bounces")
    assert len(stage["errors"]) == 6
    decided = {one["effect"]: one for one in account["plan"]["effects"]}
    for name, added in account["bounces"]["added"].items():
        # no steady fall: the plane is lit by the pot, which the plane lit before
        assert added[-1] < 0.1 * added[0]
        assert 0.1 * added[-1] < account["bounces"]["left_out"][name] < added[0]
        assert 0.0 < stage["errors"][f"{name} rays"] < added[0]
    # what the probe foresaw of the part that gains most, over its direct light
    gained = account["bounces"]["added"]["object"][0]
    foreseen = decided["interreflection"]["evidence"]["first_bounce_share"]
    assert 0.5 * foreseen < gained < 1.2 * foreseen
    # a tolerance of 0 is never reached
    assert any("max_bounces = 4" in note for note in account["bounce_notes"])
    assert account["bounce_counters"]["bounce_hits"] > 0
    assert decided["interreflection"]["forced"]


def test_rays_that_leave_more_than_the_tolerance_are_noted(coloured):
    def said(tolerance):
        plan = coloured["plan"][0]["plan"]
        notes = bounce.notes(
            coloured, plan | {"bounces": plan["bounces"] | {"tolerance": tolerance}}
        )
        return [note for note in notes if "ask for more bounce_rays" in note]

    noise = bounce.errors(coloured)
    worst = max(noise[f"{part['name']} rays"] for part in coloured["plan"][0]["plan"]["parts"])
    assert any(note.startswith("object:") for note in said(0.1 * worst))
    assert not said(1.01 * worst)


def test_bounces_that_grew_are_noted_and_nothing_else_is_said_of_their_end(coloured):
    plan = coloured["plan"][0]["plan"]
    grown = [block | {"grows": True, "left_out": None} for block in coloured["bounces"]]
    results = Results()
    results.add("plan", coloured["plan"], [])
    results.add("bounces", grown, [])
    said = [note for note in bounce.notes(results, plan) if "rays leave" not in note]
    assert [note for note in said if "averaged" not in note and "in place of" not in note] == [
        "bounces grew, which is the noise of few rays; none after the least of them is added, and "
        "nothing bounds what they leave out: ask for more bounce_rays"
    ]
    assert not any("grew" in note for note in bounce.notes(coloured, plan))
    assert not any(name.endswith("left out") for name in bounce.errors(results))


@pytest.mark.parametrize(
    ("is_bound", "said", "unsaid"),
    [(True, "albedo", "rays"), (False, "more bounce_rays", "albedo")],
)
def test_what_is_not_known_to_be_left_out_is_not_called_a_bound(coloured, is_bound, said, unsaid):
    """Of diffuse parts light stays; of others the last two bounces do not fade."""
    results = Results()
    results.add("plan", coloured["plan"], [])
    changes = {"left_out": None, "is_bound": is_bound}
    results.add("bounces", [block | changes for block in coloured["bounces"]], [])
    plan = coloured["plan"][0]["plan"]
    (note,) = (one for one in bounce.notes(results, plan) if "leave out" in one)
    assert said in note
    assert unsaid not in note
    account = bounce.account(results, plan)
    assert (account["left_out_is"], account["left_out"]) == ("not known", {})
    told = Results()
    told.add("plan", coloured["plan"], [])
    told.add("bounces", [block | {"is_bound": is_bound} for block in coloured["bounces"]], [])
    kind = bounce.account(told, plan)["left_out_is"]
    assert kind == ("a bound" if is_bound else "an estimate")
    assert not any("leave out" in one for one in bounce.notes(told, plan))


def test_the_page_shows_the_bounces_of_every_part(coloured):
    account = gather("x", coloured)["bounces"]
    empty = make_report(title="x", stages=[])
    page = report_page(empty | {"bounces": account}, {})
    for name, added in account["added"].items():
        shown = "".join(f'<td class="n">{100 * share:.3g} %</td>' for share in added)
        assert f"<td>{name}</td>{shown}" in page
    assert "each colour has its own" in page
    assert "Bounces" not in report_page(empty, {})


def test_a_receiver_has_a_brdf_of_its_own(store):
    glossy = {"model": "phong", "kd": [0.5, 0.1, 0.1], "ks": 0.2, "exponent": 4}
    results = joined(
        store, receiver={"resolution": 8, "brdf": glossy}, settings={"bake": BAKE | {"n_terms": 4}}
    )
    header, _ = stored(store, results)
    assert header.parts[1].material["model"] == "phong"
    assert header.parts[1].n_terms > 1
