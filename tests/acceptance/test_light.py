"""One light of every method over REST: submitted, fitted, downloaded, refused."""

import pytest

from prtbake import InvalidRequest
from prtbake_storage.contract.jobs import JobState
from prtbake_storage.hdf5.light import read_light
from support.deployment import Installation

pytestmark = pytest.mark.acceptance

SMALL = {
    "srbf_scattered": {"max_error": 0.3, "n_lobes": 40, "max_iterations": 1},
    "srbf_uniform": {"n_centres": 12},
    "sh": {"sh_order": 4},
    "wavelet": {"resolution": 8, "n_wavelets": 50},
}


def test_lights_of_every_method_come_back(local: Installation, tmp_path) -> None:
    jobs = {
        method: local.client.submit(
            {
                "kind": "fit_light",
                "environment": local.environment,
                "settings": {"method": method, **settings},
            }
        )
        for method, settings in SMALL.items()
    }
    for method, job in jobs.items():
        done = local.client.wait(job.id, timeout_s=120.0)
        assert done.state is JobState.succeeded, done.error
        assert done.result is not None
        assert done.result["numerics"]["light_method"] == method
        folder = tmp_path / method
        folder.mkdir()
        local.client.download_all(job.id, folder)
        light = read_light(folder / "light.h5")
        assert light.method == method
        assert light.error == done.result["errors"]["fit_light"]["light"]
        assert 0.0 < light.error < 1.0


def test_a_field_of_another_method_is_refused(local: Installation) -> None:
    with pytest.raises(InvalidRequest, match="sh_order is of method"):
        local.client.submit(
            {
                "kind": "fit_light",
                "environment": local.environment,
                "settings": {"sh_order": 4},
            }
        )


def test_a_target_out_of_reach_fails_with_the_best(local: Installation) -> None:
    job = local.client.submit(
        {
            "kind": "fit_light",
            "environment": local.environment,
            "settings": {"max_error": 1e-6, "n_lobes": 12, "max_iterations": 1},
        }
    )
    done = local.client.wait(job.id, timeout_s=120.0, check=False)
    assert done.state is JobState.failed
    assert done.error is not None
    assert done.error.kind == "input"
    assert "cannot be met: 12 lobes" in done.error.detail
