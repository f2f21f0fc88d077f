"""The tables of settings hold every field of the models, with its range, and no Python."""

import sys
from pathlib import Path

import pytest

from prtbake_storage.contract.materials import Material, Subsurface
from prtbake_storage.contract.settings import STAGES, Camera, Effects, ReceiverPlane

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.insert(0, str(DOCS))  # as MkDocs does for its hooks
from settings_tables import TABLES, kind_of, model_table, with_tables  # noqa: E402


@pytest.fixture(scope="module")
def page() -> str:
    return with_tables((DOCS / "settings.md").read_text())


@pytest.mark.parametrize(
    "model", [*STAGES.values(), Camera, Effects, Material, ReceiverPlane, Subsurface]
)
def test_every_field_has_a_row(page: str, model: type) -> None:
    for name in model.model_fields:
        assert f"| `{name}` |" in page


def test_rows_tell_range_default_and_meaning(page: str) -> None:
    for row in (
        "| `m` | number ≥ 0.01, ≤ 2 | `0.5` | Root mean square slope of the facets: smaller is glossier. |",
        "| `kd` | number ≥ 0, ≤ 1 or three | `0.3` | Diffuse reflectance. |",
        "| `n_terms` | integer ≥ 1, ≤ 256 or `null` | `null` |",
        "| `self_shadowing` | `auto` `on` `off` | `auto` |",
        "| `frame_seed` | integer ≥ 0, < 2^63 or `null` |",
        "| `cameras` | list: 1 to 16 of camera | `[{}]` |",
        "| `width` | integer ≥ 16, ≤ 4096, a multiple of 2 | `512` |",
    ):
        assert row in page


def test_qualities_stand_beside_each_other(page: str) -> None:
    assert "| field | `draft` | `low` | `medium` | `high` | `reference` |" in page
    assert "| `bake.n_centres` | `162` | `162` | `642` | `642` | `2562` |" in page
    assert "| `compress.ranks` | `[4, 16, 8]` |" in page
    # what only some of them set is the stage's default for the others
    assert "| `bake.supersample` | `1` | `1` | `1` | `2` | `2` |" in page


def test_the_page_holds_no_python(page: str) -> None:
    for word in ("Annotated", "Wire", "lambda", "Field(", "<!--", "``", "Spec", "None", "anyOf"):
        assert word not in page


def test_a_required_field_says_so() -> None:
    from prtbake_storage.contract.brdf import AbcSpec

    assert "| `ior` | number ≥ 1, ≤ 1000 | required |" in model_table(AbcSpec, "abc")
    assert kind_of({"type": "boolean"}) == "boolean"


def test_an_unknown_table_stops_the_build() -> None:
    with pytest.raises(KeyError):
        with_tables("<!-- table: nothing -->")
    assert set(TABLES) == {"brdfs", "scene", "stages", "qualities"}
