"""The chain of pictures where a part scatters light inside: one line holds all that differs."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.errors import SettingsError
from prtbake_workers.brdf.phong import Phong
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.validation.chain import (
    BOUNCED_LINE,
    LINES,
    MEANINGS,
    N_WITH_PATHS,
    STORED_LINE,
    line_names,
    validate_camera,
)
from support.scenes import asset_request, context_of, run_until, validation_of

SETTINGS = ValidateSettings(width=32, height=24, passes=8, samples=32, bounce_samples=40)
STORED = N_WITH_PATHS - 1
"""The line of the stored transfer; the reference has none."""
TINT = [0.9, 0.6, 0.3]


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """A ball of marble alone under a sky, with its scattering and without."""
    store = open_store((tmp_path_factory.mktemp("marble") / "blobs").as_uri())

    def validation(switch):
        request = asset_request(
            brdf={"model": "lambert", "albedo": TINT},
            subsurface={"medium": "marble", "mm_per_unit": 2.0},
            receiver=None,
            effects={"subsurface_scattering": switch},
        )
        context = context_of(
            store,
            request,
            {"builtin": {"name": "icosphere", "tessellation": 3}},
            {"builtin": {"name": "sun_sky", "width": 64}},
        )
        results = run_until(store, request, context, "fit_light")
        return validation_of(store, results, context["environment"]["canonical"]), results

    return {switch: validation(switch) for switch in ("auto", "off")}


def view_of(validation, **changes):
    settings = SETTINGS.model_copy(update=changes)
    (view,) = validate_camera(validation, Camera(), [np.eye(3)], settings, seed=1)
    return view


@pytest.fixture(scope="module")
def scattered(baked):
    return view_of(baked["auto"][0])


@pytest.fixture(scope="module")
def left_out(baked):
    return view_of(baked["off"][0])


def predicted(results):
    (found,) = (
        one
        for one in results["plan"][0]["plan"]["effects"]
        if one["effect"] == "subsurface_scattering"
    )
    return found["predicted_error_otherwise"]


def test_every_picture_before_the_stored_one_is_the_path_tracers(scattered):
    first = scattered.chain[0].passes
    assert all((one.passes == first).all() for one in scattered.chain[:N_WITH_PATHS])
    assert [line.error for line in scattered.budget.lines[:STORED]] == [0.0] * STORED
    assert scattered.budget.lines[STORED].name == f"scattering and {STORED_LINE}"


def test_the_line_is_small_with_scattering_and_what_was_foreseen_without(
    baked, scattered, left_out
):
    with_it, without = (view.budget.lines[STORED] for view in (scattered, left_out))
    assert without.name == f"scattering left out and {STORED_LINE}"
    # SRBFs of 162 centres and vertices a quarter of a radius apart; their noise is subtracted
    assert with_it.error < 0.03
    assert with_it.noise < 0.05
    assert without.error > 4.0 * with_it.error
    # a picture is one view under one light, the prediction a mean over all: within a factor
    share = predicted(baked["off"][1])
    assert 0.25 * share < without.error**2 < 4.0 * share
    assert predicted(baked["auto"][1]) == share


def test_the_medium_colours_what_leaves_and_the_tint_multiplies_it(baked, scattered):
    validation = baked["auto"][0]
    (part,) = validation.parts
    white = replace(part, brdf=type(part.brdf)(np.ones(1)))
    bare = view_of(replace(validation, parts=(white,))).chain[0].passes
    np.testing.assert_allclose(scattered.chain[0].passes, bare * TINT, rtol=1e-5, atol=1e-9)
    # negative twin: a medium in other channels
    medium = part.medium
    turned = Dipole(medium.scattering[::-1].copy(), medium.absorption[::-1].copy(), medium.eta)
    other = view_of(replace(validation, parts=(replace(part, medium=turned),)))
    assert other.budget.lines[STORED].error > scattered.budget.lines[STORED].error + 0.02


def test_light_leaves_where_it_falls_without_a_medium(baked):
    """The twin of a part without one: direct Monte Carlo pictures, as ever."""
    validation = baked["auto"][0]
    parts = tuple(replace(part, medium=None) for part in validation.parts)
    view = view_of(replace(validation, parts=parts))
    assert view.budget.lines[STORED].name == STORED_LINE
    assert view.budget.lines[2].error > 0.0
    # marble under a tint is darker than the tint
    assert view.budget.lines[STORED].error > 0.1


@pytest.mark.parametrize("merged", [False, True])
def test_every_line_has_a_meaning(baked, merged):
    scene = replace(baked["auto"][0], exact=None) if merged else baked["auto"][0]
    (part,) = scene.parts
    names = set()
    for scattered in ((True,), (False,), (True, False)):
        parts = tuple(replace(part, scattered=one) for one in scattered)
        for bounces, n_bounces in ((False, 0), (False, 8), (True, 8)):
            lines = line_names(replace(scene, parts=parts, baked_bounces=bounces), n_bounces)
            assert set(lines) <= set(MEANINGS)
            assert len(lines) == len(LINES) - merged
            names.add(lines[N_WITH_PATHS])
    assert len(names) == 9
    assert f"scattering, {BOUNCED_LINE}" in names


def test_progress_ends_at_one_with_and_without_the_medium_in_sight(baked):
    settings = SETTINGS.model_copy(update={"bounces": 2, "width": 16, "height": 16, "passes": 2})
    for camera in (Camera(), Camera(eye=(9.0, 0.0, 0.0), target=(19.0, 0.0, 0.0))):
        told = []
        validate_camera(
            baked["auto"][0], camera, [np.eye(3)], settings, seed=1, progress=told.append
        )
        assert told == sorted(told)
        assert told[-1] == 1.0


def test_a_medium_under_a_glossy_brdf_is_refused(baked):
    validation = baked["auto"][0]
    glossy = Phong(np.array([0.1]), np.array([0.8]), 10.0)
    parts = (replace(validation.parts[0], brdf=glossy),)
    with pytest.raises(SettingsError, match="Lambert"):
        view_of(replace(validation, parts=parts))
