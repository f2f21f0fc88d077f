"""The accuracy page: what it asks for, what it says, and that its statements can fail."""

import copy
import csv
import json
from math import prod

import pytest

from measured.accuracy import all_kept, keep, write
from measured.accuracy_scenes import ALL, FIGURE_4, LADDER_NAME, QUALITY, SCENES
from measured.accuracy_table import (
    WAVELETS,
    above,
    csv_text,
    dominated,
    equals,
    foretold,
    rounded,
    statements,
)
from prtbake_storage.contract.jobs import job_request_adapter
from prtbake_workers.planning.step_errors import POWERS

LINES = {"K terms": 0.02, "compression": 0.01}
RESOLUTION = {
    "energy_lost": 0.01, "directions": 6144, "functions": 642, "light_functions": 162,
    "vectors": 200,
}  # fmt: skip
METHODS = {
    "scattered SRBF, 162": 972,
    "SH, order 18": 972,
    "SH, order 31": 2883,
    "uniform SRBF, 162": 486,
    "area-weighted wavelets, 324": 972,
    "largest wavelets, 324": 972,
}


def study(scene, rows):
    """What is kept of a study, from (values, seconds, bytes, error) of its points."""
    points = [
        {
            "point": place, "values": values, "error": error, "noise": 0.001, "lines": LINES,
            "seconds": seconds, "shared_seconds": 0.0, "check_seconds": 1.0, "bytes": size,
            "peak_memory_bytes": 10**8, "file": "asset.h5", "frontier": ["seconds"], "errors": {},
            "resolution": RESOLUTION | {"energy_lost": 0.01 / 8.0**place},
        }
        for place, (values, seconds, size, error) in enumerate(rows)
    ]  # fmt: skip
    return {
        "name": scene.name, "title": scene.title, "about": scene.about, "machine": "A machine.",
        "wall_seconds": 100.0, "summary": "some points", "error_is": "a ratio", "skipped": [],
        "axes": [{"path": path, "values": list(values)} for path, values in scene.axes.items()],
        "points": points, "stages": [],
        "frontier": {cost: list(range(len(points))) for cost in ("seconds", "bytes")},
    }  # fmt: skip


@pytest.fixture
def kept():
    """All that the page is of: errors halve from point to point, costs grow fourfold."""
    made = {}
    for scene in ALL:
        values = {path: values[0] for path, values in scene.axes.items()}
        rows = [
            (values | {QUALITY: quality}, 4.0**place, 100 * 4**place, 0.1 / 2**place)
            for place, quality in enumerate(scene.axes[QUALITY])
        ]
        made[scene.name] = study(scene, rows)
    errors = dict(zip(METHODS, [0.02, 0.3, 0.001, 0.4, 0.01, 0.03], strict=True))
    made[FIGURE_4] = {
        "name": FIGURE_4,
        "machine": "A machine.",
        "methods": [{"name": n, "numbers": m, "seconds": 1.0} for n, m in METHODS.items()],
        "lights": {
            f"light {k}": {name: [error, error] for name, error in errors.items()} for k in range(6)
        },
    }
    return made


@pytest.mark.parametrize("quick", [True, False])
@pytest.mark.parametrize("scene", ALL, ids=lambda scene: scene.name)
def test_every_point_of_every_study_is_legal(scene, quick):
    names = (
        f"mesh-{'0' * 16}",
        f"environment-{'0' * 16}",
        f"sha256:{'0' * 64}" if scene.texture else None,
    )
    request = job_request_adapter.validate_python(scene.study(*names, quick=quick))
    points = request.points()
    assert all(point.refused is None for point in points)
    assert len(points) == (2 if quick else prod(map(len, scene.axes.values())))


def held(found):
    return [one.holds for one in statements(found)]


def test_statements_hold_of_what_is_as_it_should_be(kept):
    assert all(held(kept)), [one for one in statements(kept) if not one.holds]


def test_each_statement_fails_where_it_does_not_hold(kept):
    def broken(change):
        other = copy.deepcopy(kept)
        change(other)
        return [k for k, holds in enumerate(held(other)) if not holds]

    def beaten(found):
        found[SCENES[0].name]["points"][1]["error"] = 0.1

    def narrow(found):
        for point in found[SCENES[1].name]["points"]:
            point["seconds"] **= 0.25

    def rising(figure):
        def change(found):
            points = found[LADDER_NAME]["points"]
            points[2][figure] = points[1][figure]

        return change

    def mistaken(found):
        for own in found.values():
            for point in own.get("points", []):
                point["resolution"]["energy_lost"] **= -1.0

    def lamp(place, name, error):
        def change(found):
            found[FIGURE_4]["lights"]["light 3"][name][place] = error

        return change

    assert broken(lambda found: found.pop("bunny")) == [0]
    assert broken(lambda found: found["spot"]["axes"][0]["values"].pop()) == [0]
    assert broken(beaten) == [1]
    assert broken(narrow) == [2]
    assert [broken(rising(name)) for name in ("error", "seconds", "bytes")] == [[3], [4], [5]]
    assert broken(mistaken) == [6]
    assert broken(lambda found: found[FIGURE_4]["lights"].pop("light 2")) == [7]
    assert broken(lamp(0, "SH, order 18", 0.01)) == [8]
    assert broken(lamp(1, "uniform SRBF, 162", 0.01)) == [9]
    # more numbers may leave less, and wavelets are told and not held
    assert broken(lamp(0, "SH, order 31", 0.0)) == []
    assert broken(lamp(0, "largest wavelets, 324", 0.0)) == []
    assert not any(held({}))


def test_a_point_that_another_beats_is_found_one_by_one(kept):
    made = kept[SCENES[0].name]
    assert dominated(made, "seconds") == []
    # dearer and no better
    made["points"][2]["error"] = made["points"][1]["error"]
    assert dominated(made, "seconds") == [2]


def test_lights_are_held_against_no_more_numbers(kept):
    figure = kept[FIGURE_4]
    assert [name for names in equals(figure).values() for name in names] == [
        name for name, numbers in METHODS.items() if numbers <= 972
    ]
    assert above(figure, WAVELETS, 0) == list(figure["lights"])
    assert above(figure, WAVELETS[1:], 0) == []


def test_page_table_and_files_hold_what_is_kept(kept, tmp_path):
    for own in kept.values():
        keep(tmp_path, own)
    assert all_kept(tmp_path) == kept
    assert write(tmp_path, all_kept(tmp_path))
    text = (tmp_path / "measured" / "accuracy.md").read_text()
    for scene in ALL:
        assert f"## {scene.title}" in text
        for link in (f"../images/accuracy-{scene.name}.png", f"accuracy/{scene.name}.html"):
            assert f"({link})" in text
            assert (tmp_path / "measured" / link).exists()
    assert text.count("- holds:") == len(statements(kept))
    assert "wavelets of one kind or both leave less" in text
    assert f"| all |  | {len(foretold(kept))} |" in text
    assert "| reference | 0.625 % | 0.1 % | 4.3 min |" in text
    with (tmp_path / "measured" / "accuracy.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(len(own["points"]) for own in kept.values() if "points" in own)
    assert json.loads(rows[1]["values"])[QUALITY] == "low"


def test_a_part_leaves_the_rest(kept, tmp_path):
    """What is measured anew takes its own place; the page keeps the others' rows."""
    for own in kept.values():
        keep(tmp_path, own)
    again = copy.deepcopy(kept["spot"]) | {"wall_seconds": 7.0}
    keep(tmp_path, again)
    found = all_kept(tmp_path)
    assert list(found) == list(kept)
    assert found["spot"] == again
    assert csv_text(found) == csv_text(kept)
    for name in ("spot", FIGURE_4):
        found.pop(name)
    assert not write(tmp_path, found)
    text = (tmp_path / "measured" / "accuracy.md").read_text()
    assert "**fails**: all scenes" in text
    assert "missing: spot, figure4; at others: none" in text
    assert "Spot on a plane" not in text


def test_steps_are_foretold_from_either_side(kept):
    told = foretold(kept)
    # one pair fewer than qualities, from either side
    assert len(told) == 2 * sum(len(scene.axes[QUALITY]) - 1 for scene in ALL)
    (more,) = (one for one in told if (one.scene, one.start, one.to) == ("spot", "draft", "low"))
    # terms leave an eighth of the energy, and nothing else changes
    lines = [0.125 ** POWERS["terms"][1] * LINES["K terms"], LINES["compression"]]
    before = sum(error**2 for error in LINES.values())
    expected = 0.1 * (sum(error**2 for error in lines) / before) ** 0.5
    assert more.predicted == pytest.approx(expected)
    assert (more.before, more.measured) == (0.1, 0.05)
    # a point that differs in more than the quality is no neighbour
    other = copy.deepcopy(kept)
    other["spot"]["points"][0]["values"]["settings.bake.n_centres"] = 642
    assert len(foretold(other)) == len(told) - 2


def test_numbers_are_cut_to_what_was_measured():
    assert rounded({"a": [1.23456789, 7, None, "x"], "b": (1e-9 / 3,)}) == {
        "a": [1.2346, 7, None, "x"],
        "b": [3.3333e-10],
    }
