"""The tables of clustered PCA on a tiny scene, and that they fail where a method would be wrong."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from measured.sloan import figures, measure, table_1
from measured.sloan_scenes import BRUSHED, DIFFUSE, PHONG, ROWS, Row, polygons, transfer
from measured.sloan_table import FIGURE_2, FIGURE_3, TABLE_1, statements, trios

SQUARES = polygons(12)
FEW = (
    Row("squares, diffuse", SQUARES, DIFFUSE, 1, 4, 8, 2, "polys", 0.492, 0.432, resolution=6),
    Row("squares, glossy", SQUARES, PHONG, 16, 3, 10, 2, "head", 78.8, 43.7, resolution=6, thin=2),
)
FIGURE = replace(FEW[0], name="figure", n_clusters=6, n_components=2)
SMALL = {"clusters": (1, 6), "components": (1, 2), "by_method": (1, 2)}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    data = tmp_path_factory.mktemp("data")
    return [*table_1(FEW, data, full=False), *figures(FIGURE, data, **SMALL)]


def test_every_cell_is_measured(results):
    assert [one.of for one in results].count(TABLE_1) == 6
    assert [one.of for one in results].count(FIGURE_2) == 2 * 3
    assert [one.of for one in results].count(FIGURE_3) == 2 * 3
    assert len(trios(results)) == 2 + 2
    glossy = next(one for one in results if one.row == "squares, glossy")
    # every second vertex, half of the clusters
    assert (glossy.vertices, glossy.clusters) == (169, 5)
    assert glossy.their_ratio == pytest.approx(43.7 / 78.8)
    means_only = {one.clusters: one.error for one in results if one.method == "vq"}
    for one in results:
        if one.of == FIGURE_2 and one.components == 1:
            assert one.error < means_only[one.clusters]
    assert means_only[6] < means_only[1]


def test_the_statements_hold_and_fail_where_a_method_would_be_worse(results):
    assert [one.holds for one in statements(results)] == [True, True, True]
    swapped = {"static": "iterative", "iterative": "static"}
    worse = [replace(one, method=swapped.get(one.method, one.method)) for one in results]
    assert not statements(worse)[0].holds
    swapped = {"adaptive": "iterative", "iterative": "adaptive"}
    worse = [replace(one, method=swapped.get(one.method, one.method)) for one in results]
    assert not statements(worse)[1].holds
    larger = [
        replace(one, nbytes=one.nbytes + 4 * (one.method == "adaptive") * 10**4) for one in results
    ]
    assert [one.holds for one in statements(larger)] == [True, True, False]
    assert not any(one.holds for one in statements([]))


def test_page_and_file_say_what_was_measured(tmp_path):
    assert measure(FEW[:1], FIGURE, tmp_path, tmp_path, full=False, **SMALL)
    text = (tmp_path / "sloan.md").read_text()
    for heading in ("Table 1", "Figure 2", "Figures 3 and 4", "holds"):
        assert heading in text
    with (tmp_path / "sloan.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 + 6 + 6
    assert all(float(row["error"]) > 0.0 for row in rows)


def test_transfer_is_that_of_the_squares(tmp_path):
    """What lies under the roof sees less of the sky; the roof sees all of it."""
    signal, areas = transfer(FEW[0], tmp_path, 1)
    assert signal.shape == (2 * 13**2, 16)
    energy = np.sum(signal.astype(float) ** 2, axis=1)
    floor, roof = energy[: 13**2].reshape(13, 13), energy[13**2 :]
    np.testing.assert_allclose(roof, roof[0], rtol=1e-5)
    assert floor[6, 6] < 0.5 * roof[0]
    assert areas.sum() == pytest.approx(5.0)


def test_the_rows_are_those_of_the_paper():
    ratios = [round(row.their_iterative / row.their_static, 2) for row in ROWS]
    assert ratios == [0.80, 0.78, 0.33, 0.21, 0.55, 0.88]
    assert {row.view for row in ROWS if row.brdf is BRUSHED} == {24}
