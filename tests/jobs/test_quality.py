"""A quality below the settings of a job of one stage."""

import pytest
from pydantic import ValidationError

from prtbake_storage.contract.jobs import (
    BakeRequest,
    CompressRequest,
    FitLightRequest,
    job_request_adapter,
)
from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import AssetSettings, CompressSettings
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs.compress import compressions_of
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.planning.presets import (
    LADDER,
    StageSettings,
    below_quality,
    resolve_stages,
)
from support.local_stages import run_stage
from support.transfer_file import write_transfer

SCENE = {"mesh": "mesh-0000000000000000", "brdf": {"model": "lambert"}}


def sent(request):
    """As the service stores a request, and workers read it."""
    return job_request_adapter.validate_python(request.model_dump(mode="json"))


@pytest.mark.parametrize("quality", LADDER)
def test_a_bake_has_what_its_quality_has_in_an_asset(quality):
    given = {"n_terms": 9, "cube_resolution": 12}
    request = sent(BakeRequest(**SCENE, quality=quality, settings=given))
    settings = StageSettings.for_bake(request.settings, request.quality)
    assert settings == resolve_stages(quality, AssetSettings(bake=given))
    assert settings.bake.n_terms == 9


def test_defaults_that_are_given_stand_above_a_quality():
    request = sent(BakeRequest(**SCENE, quality="draft", settings={"n_centres": 642}))
    assert StageSettings.for_bake(request.settings, request.quality).bake.n_centres == 642
    request = sent(BakeRequest(**SCENE, quality="draft"))
    assert StageSettings.for_bake(request.settings, request.quality).bake.n_centres == 162


def test_without_a_quality_requests_are_what_they_were():
    request = BakeRequest(**SCENE, settings={"n_terms": 9})
    body = request.model_dump(mode="json")
    assert body["settings"] == request.settings.model_dump(mode="json")
    assert StageSettings.for_bake(request.settings).bake == request.settings
    light = FitLightSettings()
    assert below_quality("fit_light", light, None) is light


def test_a_light_has_the_lobes_of_its_quality():
    request = sent(FitLightRequest(environment="environment-0000000000000000", quality="draft"))
    found = below_quality("fit_light", request.settings, request.quality)
    assert (found.n_lobes, found.max_iterations) == (32, 2)
    asked = FitLightRequest(
        environment="environment-0000000000000000", quality="low", settings={"max_error": 0.1}
    )
    assert below_quality("fit_light", sent(asked).settings, "low").n_lobes == 642


def test_a_compression_has_the_sizes_of_its_quality(store, tmp_path):
    digest = store.put_file(write_transfer(tmp_path, n_channels=1), move=False)
    request = CompressRequest(
        transfer="job-1/transfer.h5", quality="draft", settings=CompressSettings(n_components=5)
    )
    context = {"artefacts": {"transfer": {"digest": digest}}}
    stages = REGISTRY.stages("compress", request.model_dump(mode="json"), context)
    results = Results()
    run_stage(stages[0], results, store)
    parts = results["plan"][0]["plan"]["parts"]
    with open_transfer(store.local_path(digest)) as file:
        header = file.header
    wanted = compressions_of(header, CompressSettings(n_components=5, max_iterations=4), "draft")
    assert [part["compression"]["n_components"] for part in parts] == [5, 5]
    assert [tuple(part["compression"]["ranks"]) for part in parts] == [one.ranks for one in wanted]
    assert wanted[0].ranks != compressions_of(header, CompressSettings())[0].ranks
    (_, task) = stages[1].tasks(results)
    assert task.args["max_iterations"] == 4


@pytest.mark.parametrize("quality", ["best", ""])
def test_other_names_are_refused(quality):
    with pytest.raises(ValidationError, match="quality"):
        BakeRequest(**SCENE, quality=quality)
