"""The measure that a budget is tuned by, against the chain of a validation and a plain mean."""

import numpy as np
import pytest

from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.decode.relight import rotation_matrix
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.jobs import tuning
from prtbake_workers.jobs.validate import assemble
from prtbake_workers.validation.chain import validate_camera
from prtbake_workers.validation.hits import trace_camera
from prtbake_workers.validation.tuning import (
    attempted_pictures,
    compressed_picture,
    tuned_references,
)
from support.scenes import relative_difference, validation_of

CAMERA = Camera(azimuth_deg=70.0)
TURN = rotation_matrix((0.0, 40.0, 0.0))
SETTINGS = ValidateSettings(width=32, height=24, passes=8, samples=64)


@pytest.fixture(scope="module")
def views(glossy_asset, store):
    """The scene as a validation sees it, as tuning does before compression, and its chain."""
    _, context, results = glossy_asset
    environment = context["environment"]["canonical"]
    finished = validation_of(store, results, environment)
    transfer = results["join"][0]["transfer"]
    with open_transfer(store.local_path(transfer)) as file:
        header = file.header
    args = {
        "transfer": transfer,
        "light": results["fit_light"][0]["light"],
        "environment": environment,
    }
    begun = assemble(args, store, header, delivered=tuning.surfaces_of(header), exact=None)
    (view,) = validate_camera(finished, CAMERA, [TURN], SETTINGS, seed=3)
    return finished, begun, view


def test_attempts_show_what_the_chain_shows_of_them(views):
    """Surfaces made of a transfer alone, without one factor, shade as the finished asset's do."""
    finished, begun, view = views
    chain = {picture.name: picture.mean for picture in view.chain}
    hits = trace_camera(begun, CAMERA, SETTINGS.width, SETTINGS.height)
    pictures = attempted_pictures(begun, hits, TURN)
    stored = next(name for name in chain if name.endswith("16-bit transfer"))
    # float32 surfaces, and relit vertices in float32
    assert relative_difference(pictures["transfer"], chain[stored]) < 1e-5
    assert relative_difference(pictures["light"], chain["light fit"]) < 1e-5
    delivered = compressed_picture(finished, finished.delivered, hits, TURN)
    assert relative_difference(delivered, chain["rounded factors"]) < 1e-5
    # another turn of the light is another picture
    other = attempted_pictures(begun, hits, rotation_matrix((0.0, 140.0, 0.0)))
    assert relative_difference(other["light"], chain["light fit"]) > 0.1


def test_a_reference_gets_the_samples_that_its_aim_asks_for(views):
    _, begun, view = views
    hits = trace_camera(begun, CAMERA, SETTINGS.width, SETTINGS.height)
    few = SETTINGS.model_copy(update={"samples": 2})
    loose, tight = (
        tuned_references(begun, hits, [TURN], few, noise=noise, seed=11)[0][0]
        for noise in (10.0, 1e-4)
    )
    assert loose.samples == 2
    # far from the aim, noise may be a fifth of the error that is there already
    assert loose.samples < tight.samples <= 64 * 2
    assert tight.variance < loose.variance
    # the same picture as the validation's, within both noises
    truth = view.chain[0]
    noise = truth.passes.var(axis=0, ddof=1).sum() / len(truth.passes)
    gap = ((tight.mean - truth.mean) ** 2).sum()
    assert gap < 6.0 * (noise + tight.variance)
    assert tight.squared_difference(tight.mean) == 0.0
    assert tight.squared_difference(np.zeros_like(tight.mean)) == pytest.approx(
        tight.squared_norm + tight.variance
    )
