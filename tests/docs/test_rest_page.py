"""The page on REST lists what the service offers, no more and no less."""

import re
from pathlib import Path

from prtbake_service.app import create_app
from prtbake_service.settings import ServiceSettings

PAGE = Path(__file__).resolve().parents[2] / "docs" / "rest.md"


def test_the_table_lists_every_call_of_the_service() -> None:
    rows = [line for line in PAGE.read_text().splitlines() if line.startswith("| `")]
    listed = set(re.findall(r"`((?:GET|POST|PUT|DELETE) /[^`?]*)`", "\n".join(rows)))
    offered = {
        f"{method.upper()} {path.removeprefix('/v1')}"
        for path, operations in create_app(ServiceSettings()).openapi()["paths"].items()
        if path.startswith("/v1")
        for method in operations
    }
    assert {_nameless(call) for call in listed} == {_nameless(call) for call in offered}


def _nameless(call: str) -> str:
    return re.sub(r"\{[a-z_]+\}", "{}", call)
