"""Figure 4's command, small, and its claim where no map is at hand."""

from dataclasses import replace

import pytest

from figures.figure4 import (
    MAPS,
    Sizes,
    cube_of,
    environments,
    judge,
    main,
    methods,
    texels_of,
)
from prtbake_storage.decode.transfer_basis import WhitenedSrbfs
from prtbake_workers.geometry.icosphere import icosphere

SMALL = Sizes(lobes=24, centres=(42, 162), orders=(7, 12), wavelets=(48, 144), max_iterations=1)


@pytest.fixture
def procedural(monkeypatch):
    monkeypatch.delenv("PRTBAKE_DATA", raising=False)
    monkeypatch.setattr("figures.figure4.SEEN_BY", WhitenedSrbfs(icosphere(2), 15.0))
    monkeypatch.setattr("figures.figure4.JUDGED_PARTS", 3)
    monkeypatch.setattr("figures.figure4.FITTED_PARTS", 2)


def test_equal_parameters_are_equal():
    """162 scattered SRBFs are 972 numbers, and so are 18^2 harmonics and 324 wavelets."""
    numbers = {method.name: method.numbers for method in methods(Sizes())}
    assert numbers["scattered SRBF, 162"] == 972
    assert numbers["SH, order 18"] == numbers["largest wavelets, 324"] == 972
    assert numbers["area-weighted wavelets, 972"] == 3 * 972
    assert len(MAPS) == 6


def test_scattered_lobes_leave_least_of_a_hall(procedural):
    """At 144 numbers, of what knows no texels; the least of any as transfer sees it."""
    cube = cube_of(environments()["hall"])
    errors, texels = judge(cube), texels_of(cube, 2)
    found = {m.name: errors(m.fit(texels)) for m in methods(SMALL)}
    best, seen = found["scattered SRBF, 24"]
    for name in ("SH, order 7", "uniform SRBF, 42", "area-weighted wavelets, 48"):
        assert best < found[name][0]
        assert seen < found[name][1]
    # the largest wavelets leave no more than those weighted by area
    assert found["largest wavelets, 48"][0] < found["area-weighted wavelets, 48"][0]
    # negative twin: half of the lobes' light is no fit
    light = methods(SMALL)[0].fit(texels)
    assert errors(replace(light, coefficients=0.5 * light.coefficients))[0] > 2.0 * best


def test_command_prints_and_writes_tables_and_pictures(tmp_path, capsys, procedural, monkeypatch):
    few = {"hall": environments()["hall"]}
    monkeypatch.setattr("figures.figure4.environments", lambda: few)
    tiny = Sizes(4, (12, 42), (3, 4), (9, 27), 1)
    assert main(["--to", str(tmp_path), "--height", "16"], tiny) == 0
    text = (tmp_path / "figure4.md").read_text()
    assert capsys.readouterr().out == text
    assert text.count("| hall") == 2
    assert (tmp_path / "figure4.png").read_bytes().startswith(b"\x89PNG")
