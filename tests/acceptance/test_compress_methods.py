"""The glossy job's transfer compressed anew by other methods, over REST."""

from pathlib import Path

import numpy as np
import pytest

from prtbake import Asset, InvalidRequest
from prtbake_storage.contract.jobs import JobState
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.decode.relight import project_light
from prtbake_storage.hdf5.light import read_light
from prtbake_storage.hdf5.transfer import open_transfer
from support.deployment import Installation
from support.main_job import Finished

pytestmark = pytest.mark.acceptance

SIZES = {
    "vq": {"n_clusters": 60},
    "pca": {"n_components": 30},
    "cpca": {"n_clusters": 4, "n_components": 12},
}


@pytest.fixture(scope="module")
def baked(
    local: Installation, undisturbed: Finished, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The folder with the glossy job's transfer and light."""
    folder = tmp_path_factory.mktemp("baked")
    for name in ("transfer.h5", "light.h5"):
        local.client.download(undisturbed.job.id, name, folder)
    return folder


@pytest.mark.parametrize("method", SIZES)
def test_a_glossy_part_is_compressed_and_relit(
    local: Installation, undisturbed: Finished, baked: Path, tmp_path: Path, method: str
) -> None:
    request = {
        "kind": "compress",
        "transfer": f"{undisturbed.job.id}/transfer.h5",
        "settings": {"method": method, "max_iterations": 4} | SIZES[method],
    }
    planned = local.client.estimate(request).plan["parts"]
    assert [part["compression"]["method"] for part in planned] == [method] * 2
    job = local.client.wait(local.client.submit(request).id)
    assert job.state is JobState.succeeded, job.error
    asset = Asset.open(local.client.download(job.id, "asset.h5", tmp_path))
    part, light = asset.data.parts[0], read_light(baked / "light.h5")
    assert part.method == method
    assert part.n_view > 1
    with open_transfer(baked / "transfer.h5") as transfer:
        rows = transfer.read(0).astype(np.float64)
    assert rows.shape == (part.n_vertices, part.n_view, asset.data.n_coeffs)
    assert job.result is not None
    stated = job.result["errors"]["compress"][part.name]
    left = np.sum((reconstruct(part, slice(None)) - rows) ** 2) / np.sum(rows**2)
    # the stated one counts vertices by area, and comes before 16 bits
    assert 0.3 * stated < left < 3.0 * stated < 0.9
    radiance = rows @ project_light(asset.data.basis, light)
    lit = asset.relight(light)[0]

    def off(found: np.ndarray) -> float:
        return float(np.linalg.norm(found - radiance) / np.linalg.norm(radiance))

    assert off(lit) < 0.5
    # negative twin: every vertex with its neighbour's
    assert off(np.roll(lit, part.n_vertices // 2, axis=0)) > 1.5 * off(lit)


def test_a_method_that_there_is_not_is_refused(local: Installation, undisturbed: Finished) -> None:
    body = {"kind": "compress", "transfer": f"{undisturbed.job.id}/transfer.h5"}
    with pytest.raises(InvalidRequest) as refused:
        local.client.submit(body | {"settings": {"method": "wavelet"}})
    assert refused.value.problem.pointer == "/settings/method"
