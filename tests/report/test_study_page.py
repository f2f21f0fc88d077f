"""The pages and the picture of a study."""

import base64
import hashlib
import json
import re
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from prtbake_workers.report.frontier_picture import FRONTIER, POINT, frontier_png
from prtbake_workers.report.log_axis import LogAxis
from prtbake_workers.report.study_page import study_page

POINTS = [(1.0, 4e5, 0.4), (4.0, 3e5, 0.1), (9.0, 9e5, 0.2), (30.0, 2e6, 0.01)]


def made(title="a study", errors=None):
    points = [
        {
            "point": place, "values": {"settings.n_clusters": 2 * place}, "error": error,
            "noise": None, "seconds": seconds, "shared_seconds": 0.5, "bytes": size,
            "file": "asset.h5", "frontier": [],
        }
        for place, (seconds, size, error) in enumerate(POINTS)
    ]  # fmt: skip
    for point, error in zip(points, errors or [], strict=False):
        point["error"] = error
    return {
        "title": title, "summary": "four points", "error_is": "a ratio",
        "axes": [{"path": "settings.n_clusters", "values": [0, 2, 4, 6]}],
        "points": points, "frontier": {"seconds": [0, 1, 3], "bytes": [1, 3]},
        "skipped": [{"point": 9, "values": {"settings.n_clusters": 0}, "reason": "not <0>"}],
        "stages": [{"name": "bake", "tiles": 3, "seconds": 1.0, "peak_memory_bytes": 5}],
    }  # fmt: skip


def test_the_policy_lets_exactly_its_own_script_run():
    page = study_page(made())
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1]
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    for kind, element in (("script", '<script type="module">'), ("style", "<style>")):
        text = page.split(element)[1].split(f"</{kind}>")[0]
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy
    assert "https://" not in page
    assert " style=" not in page  # which the policy would not let be
    assert "on the frontier" in page


def test_the_data_cannot_leave_its_element():
    hostile = made(title="</script><script>alert(1)</script><!--")
    page = study_page(hostile)
    assert page.count("<script") == 2
    data = page.split('<script type="application/json" id="study">')[1].split("</script>")[0]
    assert json.loads(data) == hostile
    assert "not &lt;0&gt;" in page


def test_the_report_runs_nothing_and_leads_to_the_plot():
    page = study_page(made(), frontier_png(made()["points"], made()["frontier"]))
    assert "<script" not in page
    assert "script-src 'none'" in page
    assert 'href="study.html"' in page
    assert "data:image/png;base64," in page


def pixels_of(study):
    return np.asarray(Image.open(BytesIO(frontier_png(study["points"], study["frontier"]))))


def is_colour(pixels, name):
    colour = np.array([int(name[at : at + 2], 16) for at in (1, 3, 5)])
    return (np.abs(pixels.astype(int) - colour) < 12).all(axis=2)


def test_the_picture_marks_frontier_and_points():
    pixels = pixels_of(made())
    assert pixels.shape == (440, 1280, 3)
    for half in (pixels[:, :640], pixels[:, 640:]):
        assert is_colour(half, FRONTIER).sum() > 100
        assert is_colour(half, POINT).sum() > 20
    # negative twin: where all are on the frontier nothing has the others' colour
    every = made() | {"frontier": {"seconds": [0, 1, 2, 3], "bytes": [0, 1, 2, 3]}}
    assert is_colour(pixels_of(every), POINT).sum() == 0


def test_the_picture_is_the_same_again():
    assert frontier_png(made()["points"], made()["frontier"]) == frontier_png(
        made()["points"], made()["frontier"]
    )


@pytest.mark.parametrize("errors", [[0.0, 0.1, 0.2, 0.3], [None] * 4, [0.1] * 4])
def test_zero_none_and_equal_errors_can_be_drawn(errors):
    study = made(errors=errors)
    if errors[0] is None:
        study["frontier"] = {"seconds": [], "bytes": []}
    assert pixels_of(study).shape == (440, 1280, 3)
    study_page(study)


def test_a_log_axis_keeps_ratios_and_puts_zero_at_its_end():
    axis = LogAxis.over([1.0, 10.0, 100.0], 0.0, 100.0)
    places = [axis.place(value) for value in (1.0, 10.0, 100.0)]
    assert places[1] - places[0] == pytest.approx(places[2] - places[1])
    assert 0.0 < places[0] < places[2] < 100.0
    assert {1.0, 10.0, 100.0} <= set(axis.ticks())
    with_zero = LogAxis.over([0.0, 1.0, 10.0], 0.0, 100.0)
    assert with_zero.place(0.0) == 0.0
    assert with_zero.place(1.0) > 10.0


@pytest.mark.parametrize("low", [1.0, 2.3, 7.77, 9.9])
@pytest.mark.parametrize("factor", [1.0, 1.3, 5.0, 1e3, 1e8])
def test_every_axis_has_some_ticks_and_not_many(low, factor):
    axis = LogAxis.over([low, low * factor], 0.0, 1.0)
    assert 3 <= len(axis.ticks()) <= 12
    assert all(axis.low <= np.log10(tick) <= axis.high for tick in axis.ticks())
