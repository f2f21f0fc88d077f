"""What the pages tell a reader to run does what they say."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
VIEWPOINT = re.compile(r"^low, high = .*?^eye = [^\n]*\n", flags=re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("page", ["README.md", "docs/client.md"])
@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0])
def test_the_eye_stands_outside_a_mesh_of_any_size(page: str, scale: float) -> None:
    found = VIEWPOINT.search((ROOT / page).read_text())
    assert found is not None
    cube = np.array([[x, y, z] for x in (0, 3) for y in (0, 1) for z in (0, 2)], np.float32)
    names = {"asset": SimpleNamespace(positions=scale * (cube + np.float32(5.0)))}
    exec(found[0], names)
    eye, positions = names["eye"], names["asset"].positions
    # outside the sphere around the box
    centre = (positions.min(axis=0) + positions.max(axis=0)) / 2
    assert np.linalg.norm(eye - centre) > np.linalg.norm(positions - centre, axis=1).max()
