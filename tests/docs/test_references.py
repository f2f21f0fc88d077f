"""Every paper that a docstring cites stands in the documentation's list, and the other way round."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("service", "workers", "storage", "clients")
CITED = re.compile(r"\[([A-Z][A-Za-z]+\d{4})\]_?")


def cited() -> set[str]:
    """Keys in the packages' own sources."""
    sources = (path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    return {key for path in sources for key in CITED.findall(path.read_text())}


def listed() -> set[str]:
    """Keys of docs/references.md."""
    table = (ROOT / "docs" / "references.md").read_text()
    return set(re.findall(r"^\| ([A-Z][A-Za-z]+\d{4}) \|", table, flags=re.MULTILINE))


def test_every_key_is_listed_and_every_listed_key_is_cited():
    assert {"Tsai2006", "Sloan2003", "Miandji2011"} <= cited()
    assert cited() == listed()
