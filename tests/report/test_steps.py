"""Where an asset lies on the frontier, and what is said of the steps beside it."""

from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from prtbake_workers.planning.step_errors import POWERS
from prtbake_workers.report.account import make_report
from prtbake_workers.report.frontier_picture import frontier_png
from prtbake_workers.report.html import report_page
from prtbake_workers.report.steps import DECIDED_BY, drawn, frontier
from prtbake_workers.validation.chain import MEANINGS

LINES = {"K terms": 0.03, "SRBF basis": 0.04, "vertex interpolation": 0.05}
BUDGET = {
    "lines": [
        {"name": name, "error": error, "noise": 0.0, "below_noise": False}
        for name, error in LINES.items()
    ],
    "total": 0.06,
    "total_noise": 0.001,
    "black_reference": False,
}
OWN = {
    "quality": None, "seconds": 10.0, "asset_bytes": 1000, "terms": [3], "error_factors": {},
    "measured_seconds": 20.0, "measured_bytes": 900,
}  # fmt: skip
MORE = {
    "quality": "high", "seconds": 40.0, "asset_bytes": 3000, "terms": [5],
    "error_factors": {"terms": 0.5, "basis": 0.25, "compression": 0.1},
    "measured_seconds": None, "measured_bytes": None,
}  # fmt: skip


def test_a_step_is_predicted_from_what_was_measured():
    found = frontier([OWN, MORE], BUDGET)
    assert found["asset"]["error"] == 0.06
    assert (found["asset"]["seconds"], found["asset"]["bytes"]) == (20.0, 900)
    (step,) = found["steps"]
    assert step["lines"] == pytest.approx(
        {"K terms": 0.015, "SRBF basis": 0.01, "vertex interpolation": 0.05}
    )
    before, after = (np.linalg.norm(list(lines.values())) for lines in (LINES, step["lines"]))
    assert step["error"] == pytest.approx(0.06 * after / before)
    assert step["error"] < 0.06
    # twice as long and nine tenths as large as predicted, and so is the step
    assert (step["seconds"], step["bytes"]) == (pytest.approx(80.0), pytest.approx(2700.0))


@pytest.mark.parametrize("budget", [None, BUDGET | {"black_reference": True}])
def test_nothing_is_said_without_an_error(budget):
    assert frontier([OWN, MORE], budget) is None
    assert frontier([], BUDGET) is None


def test_what_decides_lines_is_known_by_both_sides():
    """A line or a number under another name would silently never change."""
    assert set(DECIDED_BY) <= set(MEANINGS)
    assert set(DECIDED_BY.values()) == set(POWERS)


def test_the_page_shows_measured_and_predicted_and_a_plot():
    found = frontier([OWN, MORE], BUDGET)
    report = make_report(title="x", stages=[], ladder=[OWN, MORE], frontier=found)
    assert report["frontier"] == found
    points, marked = drawn(found)
    page = report_page(report, {}, frontier_png(points, marked))
    assert page.count("data:image/png;base64,") == 1
    assert page.index("<td>this asset</td>") < page.index("<td>high</td>")
    assert "<td>measured</td>" in page
    assert "<td>predicted</td>" in page
    assert found["predicted_by"][:40] in page
    # an asset that nobody validated has neither
    bare = report_page(make_report(title="x", stages=[], ladder=[OWN, MORE]), {})
    assert "Error beside them" not in bare
    assert "<td>predicted</td>" not in bare


def test_points_are_named_in_the_picture():
    points, marked = drawn(frontier([OWN, MORE], BUDGET))

    def dark(some):
        picture = Image.open(BytesIO(frontier_png(some, marked))).convert("L")
        return int((np.asarray(picture) < 100).sum())

    unnamed = [{k: v for k, v in point.items() if k != "label"} for point in points]
    assert dark(points) > dark(unnamed) + 200
