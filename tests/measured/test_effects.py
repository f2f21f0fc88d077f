"""The table of effects on two tiny scenes, and that it fails where planning would be wrong."""

import re
from dataclasses import replace

import numpy as np
import pytest

from measured.effect_runs import Bakes, measure, squared_error
from measured.effect_scenes import SCENES, EffectScene, builtin, lambert, made
from measured.effects import measure_scenes
from measured.effects_table import Row, merged, statements
from measured.rows import read_rows, write_rows
from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.settings import BakeSettings
from prtbake_storage.hdf5.transfer import open_transfer
from support.bounce_scenes import bowl
from support.obj_file import obj_bytes

SETTINGS = BakeSettings(
    cube_resolution=6, n_centres=42, bounce_rays=16, max_bounces=4, term_energy_lost=0.02
)
GLOSSY = {"model": "ggx", "kd": 0.3, "ks": 0.6, "alpha": 0.4, "f0": 0.2}


def bowl_file(_data):
    return obj_bytes([bowl(6, 12)])


BALL = EffectScene("ball", "a ball", builtin("icosphere", 2), {"brdf": lambert(0.7)})
BOWL = EffectScene("bowl", "a red bowl", made(bowl_file), {"brdf": lambert((0.9, 0.3, 0.2))})
PEBBLE = EffectScene("pebble", "a small ball", builtin("icosphere", 1), {"brdf": lambert(0.7)})
FEW = (BALL, BOWL)


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    return [row for scene in FEW for row in measure(scene, folder, SETTINGS)]


def row_of(rows, scene, effect):
    (found,) = (row for row in rows if (row.scene, row.effect) == (scene, effect))
    return found


def test_a_ball_needs_nothing_and_a_red_bowl_its_bounces_in_colour(rows):
    for effect in ("self_shadowing", "interreflection"):
        left = row_of(rows, "ball", effect)
        assert left.verdict == "rightly left"
        assert left.changes == 0.0
    assert row_of(rows, "ball", "colour_bleeding").verdict == "nothing to take"
    assert row_of(rows, "ball", "view_dependence").verdict == "nothing to take"
    for effect in ("self_shadowing", "interreflection", "colour_bleeding"):
        needed = row_of(rows, "bowl", effect)
        assert needed.verdict == "needed"
        assert needed.changes > needed.tolerance
        # the probe and 16 rays a vertex of 73: the bounces alike within a third of them
        assert needed.predicted == pytest.approx(needed.changes, rel=0.7)
    ball, bowl = (row_of(rows, name, "everything") for name in ("ball", "bowl"))
    assert ball.error_off == 0.0
    assert bowl.error_off > 0.1
    # all that it needs, with all rays in the first bounce: later ones have half of them
    assert 0.0 < bowl.error_decided < 0.01 * bowl.error_off


def test_errors_are_those_of_the_coefficients(tmp_path):
    """By hand on one scene: a channel beside three, and terms that one of the two lacks."""
    for scene, switch in (
        (BOWL, "colour_bleeding"),
        (replace(BALL, request={"brdf": GLOSSY}), "view_dependence"),
    ):
        bakes = Bakes(scene, open_store((tmp_path / scene.name).as_uri()), tmp_path, SETTINGS)
        on, off = (bakes.run({switch: way}) for way in ("on", "off"))
        with open_transfer(on.transfer) as a, open_transfer(off.transfer) as b:
            part = a.header.parts[0]
            more, less = a.read(0).astype(np.float64), b.read(0).astype(np.float64)
            albedo = part.albedo.astype(np.float64)[:, None]
        if switch == "colour_bleeding":
            assert (more.shape[1], less.shape[1]) == (3, 1)
            assert len(set(albedo.ravel())) > 1
            more, less = albedo * more, albedo * np.repeat(less, 3, axis=1)
        else:
            assert more.shape[1] > less.shape[1] == 1
            less = np.pad(less, ((0, 0), (0, more.shape[1] - 1), (0, 0)))
        expected = (part.areas @ ((more - less) ** 2).sum((1, 2))) / (
            part.areas @ (more**2).sum((1, 2))
        )
        assert expected > 1e-3
        assert squared_error(off.transfer, on.transfer) == pytest.approx(expected, rel=1e-4)
        assert squared_error(on.transfer, on.transfer) == 0.0


def judged(rows, scenes=("ball", "bowl")):
    return [one.holds for one in statements(rows, scenes)]


def enough(rows):
    """Ten scenes like the bowl, so that enough need an effect, and all of them quick."""
    ten = [
        replace(row, scene=f"bowl{i}", seconds_decided=1.0,
                seconds_on=None if row.seconds_on is None else 2.5)
        for i in range(10) for row in rows if row.scene == "bowl"
    ]  # fmt: skip
    return ten, [f"bowl{i}" for i in range(10)]


def test_the_statements_hold_and_each_fails_where_planning_is_wrong(rows):
    good, names = enough(rows)
    assert judged(good, names) == [True] * 4
    assert judged(good, [*names, "another"]) == [False, True, True, True]
    # an effect that matters and was left
    wrong = [
        replace(row, decided="left")
        if (row.scene, row.effect) == ("bowl3", "interreflection") else row
        for row in good
    ]  # fmt: skip
    assert judged(wrong, names) == [True, False, True, False]
    assert "interreflection of bowl3" in statements(wrong, names)[1].evidence
    slow = [replace(row, seconds_decided=1.3) for row in good]
    assert judged(slow, names) == [True, True, False, True]
    # shadows alone do not count
    few = [row for row in good if row.effect in ("everything", "self_shadowing")]
    assert judged(few, names) == [True, True, True, False]


def test_rows_are_kept_and_those_of_a_scene_replaced(rows, tmp_path):
    path = tmp_path / "effects.csv"
    assert read_rows(path, Row) == []
    write_rows(path, rows, Row, digits=4)
    kept = read_rows(path, Row)
    assert [(r.scene, r.effect, r.decided, r.verdict) for r in kept] == [
        (r.scene, r.effect, r.decided, r.verdict) for r in rows
    ]
    for own, other in zip(kept, rows, strict=True):
        assert (own.changes is None) == (other.changes is None)
        assert own.changes is None or own.changes == pytest.approx(other.changes, rel=1e-3)
    new = [Row(scene="ball", effect="everything", vertices=7)]
    both = merged(kept, new, ["bowl", "ball"])
    assert both[-1:] == new
    assert [row for row in both if row.scene == "bowl"] == [r for r in kept if r.scene == "bowl"]
    assert len(both) == 1 + sum(row.scene == "bowl" for row in kept)


def test_the_command_writes_the_table_and_tells_that_two_scenes_are_not_enough(tmp_path, capsys):
    assert not measure_scenes(
        ["pebble"], tmp_path, tmp_path, scenes=(PEBBLE, BOWL), settings=SETTINGS, warm_up=PEBBLE
    )
    said = capsys.readouterr().out
    assert "FAILS: all 2 scenes are measured: missing: bowl" in said
    text = (tmp_path / "effects.md").read_text()
    assert {row.scene for row in read_rows(tmp_path / "effects.csv", Row)} == {"pebble"}
    # every table is whole
    for block in re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE):
        assert len({len(re.split(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1
    assert text.count("**FAILS**") >= 2


def test_there_are_the_fourteen_scenes_and_each_has_a_name_of_its_own():
    assert len({scene.name for scene in SCENES}) == len({scene.title for scene in SCENES}) == 14
