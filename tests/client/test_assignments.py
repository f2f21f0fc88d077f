import pytest
import typer

from prtbake.cli.assignments import nested, parse_value


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("16", 16),
        ("0.5", 0.5),
        ("true", True),
        ("null", None),
        ("none", None),
        ("cta", "cta"),
        ("8,48,24", [8, 48, 24]),
        ("[[0, 90, 0]]", [[0, 90, 0]]),
        ('{"a": 1}', {"a": 1}),
        ("a,1", ["a", 1]),
    ],
)
def test_values(text: str, value: object) -> None:
    assert parse_value(text) == value


def test_paths_nest() -> None:
    tree = nested(["bake.n_terms=16", "bake.threads=2", "compress.ranks=1,2,3", "bake.n_terms=8"])
    assert tree == {"bake": {"n_terms": 8, "threads": 2}, "compress": {"ranks": [1, 2, 3]}}


@pytest.mark.parametrize("pairs", [["bake"], ["=3"], ["a..b=3"], ["a=1", "a.b=2"]])
def test_what_is_no_path_is_refused(pairs: list[str]) -> None:
    with pytest.raises(typer.BadParameter):
        nested(pairs)
