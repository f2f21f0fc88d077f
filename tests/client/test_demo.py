"""What the ladder prints; the jobs themselves run in the acceptance tests."""

import json
from pathlib import Path
from typing import Any

import pytest

from prtbake.cli.demo import print_ladder
from prtbake.cli.output import Output


def rung(quality: str, state: str = "succeeded") -> dict[str, Any]:
    return {
        "quality": quality,
        "job": f"asset-{quality}",
        "state": state,
        "making_seconds": 3.0,
        "seconds": 9.0,
        "bytes": 2048,
        "error": 0.02,
        "noise": 0.01,
    }


@pytest.mark.parametrize("output", list(Output))
def test_the_ladder_says_what_it_leaves(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, output: Output
) -> None:
    rungs = [rung("draft"), rung("medium", "failed"), rung("high")]
    print_ladder(rungs, tmp_path, output)
    told = capsys.readouterr()
    for name in ("ladder.json", "draft", "high"):
        assert str(tmp_path / name) in told.err
    # a job that failed left no folder
    assert str(tmp_path / "medium") not in told.err
    if output is Output.json:
        assert json.loads(told.out) == {"ladder": rungs}
    else:
        assert "medium: failed" in told.out
