"""Chen's tables: what is printed of the thesis, what the page states, and one small scene."""

from dataclasses import replace

import numpy as np
import pytest

from measured.chen import CLUSTERS, measure
from measured.chen_scenes import SCENES, SETTINGS, bake
from measured.chen_table import ChenRow, page, statements, theirs
from measured.chen_thesis import METHODS, THESIS
from measured.effect_scenes import EffectScene, builtin
from measured.rows import read_rows, write_rows

POT = EffectScene(
    "bunny-cook-torrance", "a pot", builtin("teapot", 4), {"brdf": SCENES[-1].request["brdf"]}
)


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    small = SETTINGS.model_copy(update={"cube_resolution": 6, "n_terms": 3})
    baked = bake(POT, tmp_path_factory.mktemp("data"), small)
    return measure(POT.name, baked, 64)


def test_the_thesis_is_all_there():
    assert set(THESIS) == {(scene.name, clusters) for scene in SCENES for clusters in CLUSTERS}
    numbers = sorted(int(one.number.removeprefix("5.")) for one in THESIS.values())
    assert numbers == list(range(2, 18))
    bunny = theirs("bunny-cook-torrance", 256)
    # 0.413759 / 0.529308 and 0.054501 / 0.054466
    assert bunny["coherent"].left == pytest.approx(0.78170, abs=1e-5)
    assert bunny["coherent"].rise == pytest.approx(0.00064, abs=1e-5)
    for (scene, clusters), table in THESIS.items():
        assert len(table.rows) == (3 if scene.startswith("dino") else 4)
        left = theirs(scene, clusters)
        assert left["cpca"].left == 1.0
        assert all(0.5 < one.left < 1.0 for name, one in left.items() if name != "cpca")


def test_every_method_draws_less_of_a_pot_at_no_more_error(rows):
    assert [row.method for row in rows] == list(METHODS)
    plain = rows[0]
    assert 1.0 < plain.drawn == plain.overdraw < 3.0
    for row in rows[1:]:
        assert row.drawn < plain.drawn
    assert rows[1].error <= plain.error
    assert rows[2].drawn < rows[2].overdraw
    assert rows[2].error <= plain.error
    assert rows[3].drawn <= rows[2].drawn


def _as_thesis(row, change=0.0):
    """A row with the thesis' own figures, its overdraw changed by a share of what is over one."""
    seconds, overdraw, error = THESIS[row.scene, row.clusters].rows[row.method]
    drawn = 1.0 + (overdraw - 1.0) * (1.0 + change)
    return replace(row, seconds=seconds, overdraw=drawn, drawn=drawn, error=error)


def test_the_thesis_beside_itself_holds_and_anything_worse_fails(rows):
    same = [_as_thesis(row) for row in rows]
    assert not statements(same)[0].holds  # the other tables are missing
    assert all(one.holds for one in statements(same)[1:])
    drawn_more = [same[0], _as_thesis(rows[1], 0.01), *same[2:]]
    assert [one.holds for one in statements(drawn_more)[1:]] == [False, True, True]
    larger_error = [*same[:3], replace(same[3], error=1.01 * same[3].error)]
    assert [one.holds for one in statements(larger_error)[1:]] == [True, True, False]
    assert "5.15" in statements(larger_error)[3].evidence


def test_rows_come_back_from_the_file_and_are_on_the_page(rows, tmp_path):
    write_rows(tmp_path / "chen.csv", rows, ChenRow, digits=6)
    back = read_rows(tmp_path / "chen.csv", ChenRow)
    assert [row.method for row in back] == list(METHODS)
    np.testing.assert_allclose([row.error for row in back], [row.error for row in rows], rtol=1e-5)
    text = page(back, {POT.name: POT.title}, machine="a machine", about="about")
    assert "## A pot" in text
    assert "1.529" not in text
    assert text.count("| 5.15 |") == 4
    assert "**FAILS** | all 16 tables are measured" in text
