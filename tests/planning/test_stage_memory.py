"""Predicted memory: how it grows, and where it stops growing."""

import tracemalloc

import numpy as np
import pytest

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import RenderSettings, ValidateSettings
from prtbake_workers.planning.cost import CHILD_BYTES
from prtbake_workers.planning.light_pieces import FitSamples
from prtbake_workers.planning.presets import PlannedBake
from prtbake_workers.planning.seen_pixels import SeenPixels
from prtbake_workers.planning.stage_memory import (
    REBUILT_VERTS,
    add_bounces_memory_bytes,
    fit_memory_bytes,
    quantise_memory_bytes,
    render_memory_bytes,
    validate_memory_bytes,
)
from prtbake_workers.transport.quantise import quantise_transfer

BAKE = PlannedBake(cube_resolution=8, n_centres=42)


def validation(pixels=2000, vertices=50, lobe="none", terms=1, inside=0, **changes):
    return validate_memory_bytes(
        ValidateSettings(**{"samples": 32, "passes": 4} | changes.pop("settings", {})),
        seen=[SeenPixels(10, 10, 0, (10,)), SeenPixels(pixels, vertices, inside, (pixels,))],
        part_terms=[terms],
        lobes=[lobe],
        bake=BAKE,
        n_texels=changes.pop("n_texels", 512),
        **changes,
    )


def test_the_camera_that_shows_most_leads_validation():
    plain = validation()
    assert plain > CHILD_BYTES
    for more in (
        validation(pixels=4000),
        validation(lobe="isotropic", terms=4),
        validation(settings={"samples": 64}),
        validation(settings={"passes": 8}),
        validation(vertices=5000),
        validation(n_texels=1 << 18),
        validation(baked_bounces=True, settings={"bounce_samples": 32}),
        validation(inside=1500, settings={"bounce_samples": 32}),
    ):
        assert more > plain
    for lobe in ("isotropic", "anisotropic"):
        assert validation(lobe=lobe, terms=8) > validation(lobe=lobe, terms=4) > plain


def test_validation_works_in_blocks_that_bound_it():
    """Of more samples only the pictures are kept."""
    full, twice = (validation(pixels=n, settings={"samples": 512}) for n in (20_000, 40_000))
    assert twice - full == 96 * 20_000 * 4
    # many terms take smaller blocks
    few, many = (
        validation(pixels=20_000, lobe="isotropic", terms=t, settings={"samples": 512})
        for t in (16, 64)
    )
    assert many < 1.2 * few


def test_paths_from_inside_a_medium_hold_more_of_each_and_are_more():
    bounced = {"baked_bounces": True, "settings": {"bounce_samples": 32}}
    outside, inside = (validation(inside=n, **bounced) for n in (0, 2000))
    assert inside - CHILD_BYTES > 1.5 * (outside - CHILD_BYTES)
    # those of one block at once
    settings = {"samples": 1, "bounce_samples": 64, "passes": 2}
    few, many = (validation(pixels=n, inside=n, settings=settings) for n in (400_000, 800_000))
    assert many - few == 96 * 400_000 * 2


def test_light_on_the_basis_is_held_at_a_few_directions_at_once():
    small, large, larger = (validation(pixels=9, n_texels=n) for n in (512, 1 << 15, 1 << 18))
    assert small < large == larger


def test_the_other_stages_grow_with_what_they_hold():
    assert add_bounces_memory_bytes(0, 642) == CHILD_BYTES
    # direct light and the sum in float32, and one block in 16 and 32 bits
    assert add_bounces_memory_bytes(20_000, 100) - add_bounces_memory_bytes(10_000, 100) == (
        pytest.approx(14e6)
    )
    # colours share the direct light; smaller blocks leave what rounding holds
    assert add_bounces_memory_bytes(20_000, 300, n_channels=3) < (
        add_bounces_memory_bytes(20_000, 300)
    )
    whole, halves, many = (add_bounces_memory_bytes(20_000, 99, n_blocks=n) for n in (1, 2, 99))
    assert whole > halves > many == add_bounces_memory_bytes(20_000, 99, n_blocks=3)
    one = quantise_memory_bytes([(100, 600), (REBUILT_VERTS, 600)])
    assert one == quantise_memory_bytes([(9 * REBUILT_VERTS, 600)])
    assert one > quantise_memory_bytes([(100, 600)])
    small, large = (render_memory_bytes(RenderSettings(width=w)) for w in (320, 640))
    assert large > small
    few, many = (fit_memory_bytes(FitLightSettings(n_lobes=n), n_texels=1 << 17) for n in (9, 90))
    assert many > few
    assert fit_memory_bytes(FitLightSettings(n_lobes=90), n_texels=64) < many


@pytest.mark.parametrize(("verts", "values"), [(8, 1 << 17), (1 << 10, 1 << 10)])
def test_rounding_holds_levels_of_all_and_more_of_those_at_hand(rng, verts, values):
    """One vertex at a time, which is more than is rounded at a time of others, and 64."""
    total = rng.standard_normal((verts, 1, values), np.float32)
    tracemalloc.start()
    quantise_transfer(total)
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # direct light and the sum were there before
    before = CHILD_BYTES + 2 * total.nbytes
    predicted = add_bounces_memory_bytes(verts, values, n_blocks=values) - before
    assert predicted == pytest.approx(held, rel=0.03)


def test_a_fit_holds_the_pieces_of_the_map():
    """Measured on the built-in maps, MB: a hall of lamps 128 texels wide, and a sun 512 wide."""
    hall, sun = FitSamples(30_584, 108_274, 244_738), FitSamples(132_296, 137_246, 145_664)
    lobes = [FitLightSettings(n_lobes=n) for n in (107, 162)]
    assert fit_memory_bytes(lobes[0], n_texels=8192, samples=hall) == pytest.approx(201e6, rel=0.1)
    assert fit_memory_bytes(lobes[1], n_texels=1 << 17, samples=sun) == pytest.approx(
        231e6, rel=0.1
    )
    # negative twin: by its texels the hall would be another's
    assert fit_memory_bytes(lobes[0], n_texels=8192) < 0.85 * 201e6
    for method, fields, measured in (
        ("sh", {"sh_order": 18}, 165e6),
        ("srbf_uniform", {"n_centres": 642}, 270e6),
        ("wavelet", {"resolution": 64}, 279e6),
    ):
        settings = FitLightSettings(method=method, **fields)
        assert fit_memory_bytes(settings, n_texels=1 << 17) == pytest.approx(measured, rel=0.1)
