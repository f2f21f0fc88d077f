"""Coherence, fewer draws and superclusters through the stages of a compress job."""

import numpy as np
import pytest

from prtbake_storage.contract.brdf import CookTorranceSpec, LambertSpec
from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.decode.quantise import quantise
from prtbake_storage.decode.transfer_basis import WhitenedSrbfs
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import (
    TransferHeader,
    TransferPart,
    join_transfer,
    write_transfer_tile,
)
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results
from prtbake_workers.basis.srbf import default_bandwidth
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.compress.superclusters import registers_of_clusters
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.jobs.compress import standalone_stages
from prtbake_workers.jobs.report import gather, summary, write
from support.grid_mesh import sphere_faces
from support.local_stages import run_stages
from synthetic_transfer import equal_area_directions, synthetic_transfer

VERTS = (300, 200)
COEFFS = 42
PLAIN = {"max_iterations": 4, "n_clusters": 10, "ranks": (3, 12, 5), "n_components": 3}


@pytest.fixture(scope="module")
def transfer(store, tmp_path_factory):
    """Digest of a transfer file: two spheres of triangles, a glossy and a diffuse one."""
    folder = tmp_path_factory.mktemp("overdraw")
    parts, tiles, faces, start = [], [], [], 0
    for name, spec, verts in zip(
        ("object", "receiver"),
        (CookTorranceSpec(m=0.5), LambertSpec(albedo=0.7)),
        VERTS,
        strict=True,
    ):
        model = factorise(brdf_from_spec(spec), n_terms=4, n_theta=12, n_phi=32)
        rows = synthetic_transfer(verts, model.n_terms, COEFFS)
        packed = quantise(rows, (2,))
        tiles.append([folder / f"{name}.h5"])
        write_transfer_tile(
            tiles[-1][0], packed.values, scale=packed.scale[:, :, 0],
            signal_energy=np.sum(rows.astype(float) ** 2, axis=(1, 2)),
            residual_energy=np.zeros(verts),
        )  # fmt: skip
        directions = equal_area_directions(verts)
        parts.append(
            TransferPart(
                name=name, vertex_range=(start, start + verts), material=spec.model_dump(),
                areas=np.ones(verts), n_terms=model.n_terms, n_channels=1,
                frames=None if model.is_constant_phi else tangent_frames(directions),
                albedo=model.albedo, factorisation=model.tables(),
            )
        )  # fmt: skip
        faces.append(sphere_faces(directions) + np.int32(start))
        start += verts
    points = np.concatenate([equal_area_directions(verts) for verts in VERTS])
    header = TransferHeader(
        positions=points, faces=np.concatenate(faces), normals=points, uv=None,
        basis=WhitenedSrbfs(icosphere(1), default_bandwidth(COEFFS)), parts=tuple(parts),
    )  # fmt: skip
    join_transfer(folder / "transfer.h5", header, tiles)
    return store.put_file(folder / "transfer.h5", move=False)


def _run(store, transfer, **settings):
    stages = standalone_stages(transfer, CompressSettings(**PLAIN, **settings), 1)
    results = run_stages(stages, store)
    asset = read_asset(store.local_path(results["quantise"][0]["asset"]))
    return results, asset


@pytest.fixture(scope="module")
def plain(store, transfer):
    return _run(store, transfer)


@pytest.fixture(scope="module")
def tuned(store, transfer):
    return _run(store, transfer, coherence=0.5, overdraw_budget=0.05, registers=40)


def test_every_asset_states_its_overdraw(plain, tuned):
    for results, asset in (plain, tuned):
        for index, result in enumerate(results["compress"]):
            assert result["overdraw"] == pytest.approx(asset.overdraw_of(index))
            assert 1.0 < result["overdraw"] < 3.0
        # all parts together, triangle by triangle
        labels = np.concatenate(
            [100 * index + part.labels for index, part in enumerate(asset.parts)]
        )
        drawn = np.mean([len(set(corners)) for corners in labels[asset.faces].tolist()])
        assert results["quantise"][0]["overdraw"] == pytest.approx(drawn)


def test_fewer_draws_for_at_most_the_budget(plain, tuned):
    for before, after in zip(plain[0]["compress"], tuned[0]["compress"], strict=True):
        assert after["overdraw"] < before["overdraw"]
        # the search starts from the coherent clusters, whose error is the last but one
        assert after["objective"][-1] <= 1.05 * after["objective"][-2] * (1.0 + 1e-9)


def test_index_buffers_are_in_the_asset_where_they_were_asked_for(plain, tuned):
    assert all(part.superclusters is None for part in plain[1].parts)
    assert plain[0]["quantise"][0]["superclusters"] == [None, None]
    for index, part in enumerate(tuned[1].parts):
        groups = part.superclusters
        assert groups is not None
        assert groups.registers == 40
        stated = tuned[0]["quantise"][0]["superclusters"][index]
        drawn = len(groups.indices) / len(tuned[1].faces_of(index))
        assert stated == {"count": groups.n_superclusters, "overdraw": pytest.approx(drawn)}
        assert drawn < tuned[1].overdraw_of(index)
    made = tuned[1].provenance["compress"]
    assert (made["coherence"], made["overdraw_budget"], made["registers"]) == (0.5, 0.05, 40)
    assert "registers" not in plain[1].provenance["compress"]


def test_report_and_result_say_it_of_every_asset(store, tmp_path, plain, tuned):
    for results, asset in (plain, tuned):
        written = write(gather("compress", results), TaskContext(store, tmp_path, lambda _: None))
        ended = Results()
        ended.add("report", [written], [])
        result = summary(ended)
        assert result["overdraw"] == pytest.approx(asset.overdraw)
        assert f"a triangle is drawn {asset.overdraw:.2f} times" in result["summary"]
        for index, part in enumerate(result["parts"]):
            assert part["overdraw"] == results["compress"][index]["overdraw"]
        assert f"{asset.overdraw_of(0):.2f} times" in store.read_bytes(written["html"]).decode()


def test_the_report_says_it_of_each_part(store, tmp_path, tuned):
    results, _ = tuned
    written = write(gather("compress", results), TaskContext(store, tmp_path, lambda _: None))
    for index, part in enumerate(written["report"]["parts"]):
        assert part["overdraw"] == results["compress"][index]["overdraw"]
        assert part["superclusters"] == results["quantise"][0]["superclusters"][index]
    page = store.read_bytes(written["html"]).decode()
    assert "drawn" in page
    assert f"{written['report']['parts'][0]['superclusters']['overdraw']:.2f}" in page


def test_alpha_zero_is_the_file_without_coherence(store, transfer, plain):
    results, _ = _run(store, transfer, coherence=0.0)
    factors = [result["factors"] for result in results["compress"]]
    assert factors == [result["factors"] for result in plain[0]["compress"]]
    other, _ = _run(store, transfer, coherence=0.5)
    assert factors != [result["factors"] for result in other["compress"]]


def test_registers_that_hold_no_cluster_are_refused_by_planning(store, transfer):
    (plan, *_) = standalone_stages(transfer, CompressSettings(**PLAIN, registers=3), 1)
    with pytest.raises(SettingsError, match="registers is 3: a cluster of object takes 4"):
        run_stages([plan], store)


def test_ranks_that_were_searched_are_held_against_registers_after_the_fit(store, transfer):
    settings = CompressSettings(
        max_iterations=2, n_clusters=10, method="cpca", max_error=0.02, registers=2
    )
    stages = standalone_stages(transfer, settings, 1)[:2]
    assert [stage.name for stage in stages] == ["plan", "compress"]
    with pytest.raises(SettingsError, match=r"registers is 2: cluster \d+ takes"):
        run_stages(stages, store)


def test_registers_beside_bytes_hold_what_is_delivered(store, transfer):
    """Ample factors take more registers than there are; what stays of them for the bytes does not."""

    def run(**settings):
        asked = CompressSettings(max_iterations=1, n_clusters=4, **{"method": "cpca"} | settings)
        done = run_stages(standalone_stages(transfer, asked, 1), store)
        (made,) = done["quantise"]
        asset = read_asset(store.local_path(made["asset"]))
        needs = [
            int(registers_of_clusters(part.ranks, with_mean=part.means is not None).max())
            for part in asset.parts
        ]
        return made["bytes"], max(needs)

    free, need = run(max_bytes=60_000)
    assert free <= 60_000
    assert need > 20
    # where bytes buy more than registers hold, registers decide
    size, held = run(max_bytes=60_000, registers=6)
    assert size < 0.9 * 60_000
    assert held == 6
