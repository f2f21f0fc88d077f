"""The page of a small job, read back: every figure is the report's, every table is whole."""

import copy
import re
import shlex

import pytest

from measured.pages import RankPair, Run, page, percent, size
from measured.scenes import DATA, SCENES
from prtbake_storage.blobs.opening import open_store
from prtbake_workers.jobs.registry import REGISTRY
from support.local_stages import run_stages
from support.scenes import asset_request, context_of, run_asset

RANKS = (3, 12, 6)
SETTINGS = {
    "bake": {"cube_resolution": 8, "n_centres": 42, "n_terms": 3, "bounce_rays": 8, "max_bounces": 2},
    "compress": {"n_clusters": 2, "max_iterations": 2, "ranks": list(RANKS)},
    "fit_light": {"n_lobes": 12},
    "render": {"width": 32, "height": 24},
    "validation": {
        "width": 32, "height": 24, "passes": 2, "samples": 4, "cameras": [{"name": "front"}],
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    """The reports of a glossy ball on a plane, and of a compression of its transfer."""
    store = open_store((tmp_path_factory.mktemp("measured") / "blobs").as_uri())
    request = asset_request(
        receiver={"resolution": 6}, effects={"interreflection": "on"}, settings=SETTINGS
    )
    ball = {"builtin": {"name": "icosphere", "tessellation": 2}}
    context = context_of(store, request, ball, {"builtin": {"name": "sun_sky", "width": 32}})
    results = run_asset(store, request, context)
    context["artefacts"]["transfer"] = {"digest": results["join"][0]["transfer"]}
    compress = {
        "kind": "compress", "transfer": "job/transfer.h5", "settings": SETTINGS["compress"],
    }  # fmt: skip
    compressed = run_stages(REGISTRY.stages("compress", compress, context), store)
    return tuple(one["report"][0]["report"] for one in (results, compressed))


def page_of(report, pairs=()):
    return page(
        Run("A ball", "A glossy ball.", "prtbake submit asset", "Here.", 125.0, report, {}), pairs
    )


def tables(text):
    """Read a page's tables back, by their section's heading: lists of rows of cells."""
    found, heading = {}, ""
    for line in text.splitlines():
        if line.startswith("## "):
            heading = line[3:]
        elif line.startswith("| "):
            cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
            found.setdefault(heading, []).append(cells)
    return found


def ratio(cell):
    """The number that a cell of percents states."""
    return float(re.fullmatch(r"\**([0-9.e+-]+) %.*", cell)[1]) / 100


def test_every_table_is_whole(reports):
    report, compressed = reports
    found = tables(page_of(report, [RankPair(RANKS, compressed, "1 MB")]))
    assert list(found) == [
        "Parts", "Each stage's own error", "What each stage cost", "Bounces", "Ranks", "End to end",
        "Picture by picture", "Effects",
    ]  # fmt: skip
    for rows in found.values():
        assert len(rows) > 2
        assert {len(row) for row in rows} == {len(rows[0])}
        assert set(rows[1]) == {"---"}


def test_the_figures_are_those_of_the_report(reports):
    report, compressed = reports
    found = tables(page_of(report, [RankPair(RANKS, compressed, "1 MB")]))
    errors = {(stage, of): ratio(cell) for stage, of, cell in found["Each stage's own error"][2:]}
    assert errors == {
        # three digits
        (stage, of): pytest.approx(error, rel=6e-3)
        for stage, own in report["errors"].items()
        for of, error in own.items()
    }
    costs = found["What each stage cost"][2:]
    assert [row[0] for row in costs[:-1]] == [stage["name"] for stage in report["stages"]]
    assert sum(float(row[2]) for row in costs[:-1]) == pytest.approx(
        report["seconds"]["total"], abs=0.05 * len(costs)
    )
    assert [[ratio(cell) for cell in cells] for _, *cells in found["Bounces"][2:]] == [
        pytest.approx(added, rel=6e-3)
        for added in zip(*report["bounces"]["added"].values(), strict=True)
    ]
    lines = found["End to end"][2:]
    budget = report["budget"]
    assert [ratio(row[1]) for row in lines] == [
        # hundredths of a percent
        pytest.approx(value, abs=6e-5)
        for value in (
            *(line["error"] for line in budget["lines"]), budget["sum_of_lines"], budget["total"],
        )
    ]  # fmt: skip
    assert [row[1].strip("*").endswith("\\") for row in lines[:-2]] == [
        line["below_noise"] for line in budget["lines"]
    ]
    (pair,) = found["Ranks"][2:]
    assert pair[0] == "3, 12, 6"
    assert ratio(pair[1]) == pytest.approx(compressed["errors"]["compress"]["object"], rel=6e-3)
    assert pair[2] == size(compressed["bytes"]["asset.h5"])
    decided = {row[0]: row[1] for row in found["Effects"][2:]}
    assert decided["interreflection"] == "taken, forced"
    assert decided["subsurface scattering"] == "left"


@pytest.mark.parametrize("stage", ["bake", "bounces", "compress", "fit_light"])
def test_another_error_is_another_page(reports, stage):
    """Negative twin: no figure of the page is fixed."""
    other = copy.deepcopy(reports[0])
    (account,) = (one for one in other["stages"] if one["name"] == stage)
    for name in account["errors"]:
        account["errors"][name] *= 1.5
    assert page_of(other) != page_of(reports[0])


def test_what_a_job_did_not_do_is_said(reports):
    report = reports[0] | {"bounces": None, "notes": []}
    text = page_of(report)
    assert "None were baked" in text
    assert "## Notes" not in text
    assert "## Ranks" not in text


def test_the_fall_of_the_objective_is_told_of_iterations_alone(reports):
    (told,) = (line for line in page_of(reports[0]).splitlines() if line.startswith("Objective"))
    objective = reports[0]["parts"][0]["objective"]
    expected = [pytest.approx(value / objective[0], abs=5e-5) for value in objective]
    assert [float(value) for value in re.findall(r"\d\.\d{4}", told)] == expected
    assert "receiver" not in told


def test_bars_in_reasons_do_not_split_cells(reports):
    other = copy.deepcopy(reports[0])
    other["effects"][0]["reason"] = "|a| < |b|"
    rows = tables(page_of(other))["Effects"]
    assert {len(row) for row in rows} == {4}
    assert rows[2][2] == "\\|a\\| < \\|b\\|"


@pytest.mark.parametrize(
    ("count", "text"),
    [(999, "999 B"), (999.6, "1 kB"), (10_900_000, "10.9 MB"), (2.6e9, "2.60 GB")],
)
def test_sizes_are_decimal(count, text):
    assert size(count) == text


def test_percents_keep_three_digits():
    assert percent(0.006083) == "0.608 %"
    assert percent(7.71e-10) == "7.71e-08 %"
    assert percent(None) == ""


def test_commands_name_the_data_by_its_variable():
    for scene in SCENES:
        for quick in (False, True):
            command = scene.command(quick=quick)
            assert command.split() != []
            # every file is below the variable: no folder of the machine that ran it is told
            files = [word for word in command.split() if "/" in word]
            assert len(files) >= 2
            assert all(word.startswith(f"{DATA}/") for word in files)
            assert shlex.split(command.replace("\\\n", ""))[3:] == scene.arguments(quick=quick)
