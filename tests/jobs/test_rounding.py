"""The delivered asset's bits and error: chosen, stated in the file, measured from it, in the report."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.decode.quantise import peak_scales
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_storage.hdf5.writer import write_asset
from prtbake_workers.compress.rounding_error import rounding_error
from prtbake_workers.jobs.report import gather
from prtbake_workers.jobs.rounding import SHARE, check_stated, options, write_rounded
from support.scenes import asset_request, ball_context, run_until

AUTO = options(CompressSettings())


@pytest.fixture(scope="module")
def made(store):
    """A ball and its plane, through compression and rounding as by default."""
    request = asset_request()
    return run_until(store, request, ball_context(store, request), "quantise")


@pytest.fixture
def write(store, made, tmp_path):
    """Round the exact factors of the ball in another way."""
    exact = read_asset(store.local_path(made["quantise"][0]["exact"]))
    left = [result["errors"][result["name"]] for result in made["compress"]]

    def rounded(rounding, **changes):
        with open_transfer(store.local_path(made["join"][0]["transfer"])) as transfer:
            given = {"exact": exact, "left": left} | changes
            path = tmp_path / "a.h5"
            return write_rounded(path, given["exact"], transfer, rounding, given["left"])

    return rounded


def measured_densely(store, made, name="asset"):
    """Squared-error ratio of the factors of each part, from the files and every vertex."""
    exact, seen = (
        read_asset(store.local_path(made["quantise"][0][key])) for key in ("exact", name)
    )
    ratios = []
    with open_transfer(store.local_path(made["join"][0]["transfer"])) as transfer:
        for index, (before, after) in enumerate(zip(exact.parts, seen.parts, strict=True)):
            areas = transfer.header.parts[index].areas
            off = (reconstruct(after, slice(None)) - reconstruct(before, slice(None))).astype(float)
            energies = transfer.energies(index)
            energy = areas @ (energies.signal - energies.residual)
            ratios.append(areas @ (off**2).sum(axis=(1, 2)) / energy)
    return ratios


def test_rounding_adds_a_hundredth_of_what_compression_leaves(store, made):
    (quantised,) = made["quantise"]
    seen = read_asset(store.local_path(quantised["asset"]))
    for part, dense, compressed in zip(
        seen.parts, measured_densely(store, made), made["compress"], strict=True
    ):
        stated, left = part.precision.error, compressed["errors"][part.name]
        assert 0.9 * SHARE * left <= stated <= SHARE * left
        # float32 in the dense oracle
        assert quantised["errors"][part.name] == pytest.approx(dense, rel=1e-3)
        texture = quantised["errors"].get(f"{part.name} view texture's rounding", 0.0)
        assert stated == pytest.approx(dense + texture, rel=1e-3)
    assert quantised["notes"] == []
    assert seen.provenance["compress"]["bits"] == "auto"


def test_the_asset_is_smaller_than_with_16_bits(store, made, write, tmp_path):
    plain = write({"bits": 16, "max_quantisation_error": None})
    factors = [p.precision.bits for p in plain.asset.parts]
    assert all(set(bits.values()) == {16} for bits in factors)
    ours = store.local_path(made["quantise"][0]["asset"]).stat().st_size
    # mesh, tables and tangents stay as they are
    assert ours < 0.75 * (tmp_path / "a.h5").stat().st_size


def test_the_report_says_bits_and_error(store, made):
    seen = read_asset(store.local_path(made["quantise"][0]["asset"]))
    account = gather("x", made)
    for part, said in zip(seen.parts, account["precision"], strict=True):
        assert said == {"bits": dict(part.precision.bits), "error": part.precision.error}
        assert all(2 <= bits <= 16 for bits in said["bits"].values())


@pytest.mark.parametrize("bound", [1e-2, 1e-4, 1e-6])
def test_a_bound_of_ones_own_is_met_and_used(write, bound):
    found = write({"bits": "auto", "max_quantisation_error": bound})
    for part in found.asset.parts:
        assert 0.9 * bound <= part.precision.error <= bound


@pytest.mark.parametrize("bound", [0.0, 1e-14])
def test_a_bound_that_cannot_be_met_is_refused_with_the_best_that_can(write, bound):
    with pytest.raises(SettingsError, match=r"16 bits add .* to part 'object'") as refused:
        write({"bits": "auto", "max_quantisation_error": bound})
    assert refused.value.pointer == "/settings/compress/max_quantisation_error"


def test_without_a_bound_a_perfect_fit_keeps_16_bits(write):
    found = write(AUTO, left=[0.0, 0.0])
    for part in found.asset.parts:
        assert max(part.precision.bits.values()) == 16
        assert part.precision.error < 1e-7


def test_eight_bits_are_noted_where_they_cost_more_than_compression(write, store, made):
    found = write({"bits": 8, "max_quantisation_error": None}, left=[1e-6, 1e-6])
    assert [note.partition(":")[0] for note in found.notes] == ["object", "receiver"]
    assert "8 bits add" in found.notes[0]
    assert all(set(p.precision.bits.values()) == {8} for p in found.asset.parts)


def test_black_transfer_is_held_without_error(write, store, made):
    exact = read_asset(store.local_path(made["quantise"][0]["exact"]))
    black = tuple(
        replace(part, weights=np.zeros_like(part.weights), **(
            {} if part.means is None else {"means": np.zeros_like(part.means)}
        ))
        for part in exact.parts
    )  # fmt: skip
    found = write(AUTO, exact=replace(exact, parts=black))
    for part in found.asset.parts:
        assert part.precision.error < SHARE


def test_a_broken_bound_and_a_wrong_statement_are_found(store, made, write, tmp_path):
    """What the job checks of its own file: coarser factors than the file says are refused."""
    found = write({"bits": "auto", "max_quantisation_error": 1e-4})
    exact = read_asset(store.local_path(made["quantise"][0]["exact"]))
    with open_transfer(store.local_path(made["join"][0]["transfer"])) as transfer:
        areas = [part.areas for part in transfer.header.parts]
        energies = [
            own @ (transfer.energies(i).signal - transfer.energies(i).residual)
            for i, own in enumerate(areas)
        ]
    good = rounding_error(exact.parts[0], found.asset.parts[0], areas[0])
    check_stated(found.asset.parts[0], good, energies[0], 1e-4)
    path = tmp_path / "coarse.h5"
    coarse = [peak_scales(part, 5) for part in exact.parts]
    write_asset(path, exact, bits=coarse, errors=[1e-5, 1e-5])
    part = read_asset(path).parts[0]
    error = rounding_error(exact.parts[0], part, areas[0])
    with pytest.raises(RuntimeError, match="and the file says 1e-05"):
        check_stated(part, error, energies[0], 1e-4)
    true = error.total / energies[0]
    write_asset(path, exact, bits=coarse, errors=[true, true])
    with pytest.raises(RuntimeError, match=r"above the bound of 0\.0001"):
        check_stated(read_asset(path).parts[0], error, energies[0], 1e-4)


def test_the_settings_refuse_a_bound_beside_a_number_of_bits():
    with pytest.raises(ValueError, match="max_quantisation_error goes with bits 'auto'"):
        CompressSettings(bits=16, max_quantisation_error=1e-3)
    with pytest.raises(ValueError, match="bits"):
        CompressSettings(bits=12)
    assert CompressSettings(bits=8).max_quantisation_error is None
