"""The chain of pictures on a small scene: the budget closes, and frames do not matter."""

import numpy as np
import pytest

from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.decode.relight import rotation_matrix
from prtbake_workers.validation.chain import LINES, validate_camera
from support.scenes import (
    asset_request,
    relative_difference,
    run_until,
    teapot_context,
    validation_of,
)

SETTINGS = ValidateSettings(width=64, height=48, passes=6, samples=128)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return open_store((tmp_path_factory.mktemp("chain") / "blobs").as_uri())


def chain(store, camera, rotations, **settings):
    request = asset_request(settings=settings)
    context = teapot_context(store, request)
    results = run_until(store, request, context, "fit_light")
    scene = validation_of(store, results, context["environment"]["canonical"])
    return validate_camera(scene, camera, rotations, SETTINGS, seed=1)


@pytest.fixture(scope="module")
def plain(store):
    return chain(store, Camera(), [np.eye(3), rotation_matrix((0.0, 90.0, 0.0))])


def test_the_budget_closes(plain):
    for view in plain:
        assert [line.name for line in view.budget.lines] == list(LINES[1:])
        assert view.budget.total <= view.budget.sum_of_lines * (1 + 1e-9)
        assert view.budget.total >= view.budget.sum_of_lines / 3


def test_turning_the_light_changes_the_pictures(plain):
    assert relative_difference(plain[1].delivered, plain[0].delivered) > 0.05


def test_the_delivered_picture_resembles_the_reference(plain):
    assert 0.0 < plain[0].budget.total < 0.4


def picture(view, name):
    return view.chain[LINES.index(name)].mean


def test_random_frames_change_no_picture(store, plain):
    """Terms come in whole +-m pairs, so a turn of a frame is a rotation within them.

    What is left is float32 and 16-bit rounding of the transfer: 1e-5 was measured.
    """
    turned = chain(store, Camera(), [np.eye(3)], bake={"frame_seed": 3})
    for name in ("K terms", "vertex interpolation", "SRBF basis", "16-bit transfer"):
        assert relative_difference(picture(turned[0], name), picture(plain[0], name)) < 1e-3
    # after compression the approximation differs, but not beyond its own error
    error = plain[0].budget.lines[LINES.index("compression") - 1].error
    assert relative_difference(turned[0].delivered, plain[0].delivered) < 4 * error + 1e-3
