"""What rounding costs: measured without any vertex' transfer, and foreseen from the steps."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.decode.quantise import dequantised, peak_scales, round_part
from prtbake_storage.decode.view_map import hemi_octahedral_inverse
from prtbake_workers.compress.rounding_error import (
    cosine_weights,
    foreseen_error,
    number_weights,
    rounding_error,
)
from support.rounded_parts import dense, make_part, with_factor

KINDS = [("cta", 1), ("cta", 3), ("cpca", 1), ("cpca", 3)]


def rounded(part, scales):
    levels = round_part(part, scales)
    factors = {name: dequantised(name, q, scales[name], part.labels) for name, q in levels.items()}
    return replace(part, **factors)


@pytest.mark.parametrize(("method", "channels"), KINDS)
def test_it_is_the_difference_of_the_transfers(rng, method, channels):
    part = make_part(rng, method, n_channels=channels)
    areas = rng.uniform(0.1, 3.0, part.n_vertices)
    after = rounded(part, peak_scales(part, 7))
    off = ((dense(after) - dense(part)) ** 2).sum(axis=(1, 2, 3))
    # float64 sums on either side
    assert rounding_error(part, after, areas).factors == pytest.approx(areas @ off, rel=1e-9)
    # negative twin: the areas of other vertices
    wrong = rounding_error(part, after, np.roll(areas, 1)).factors
    assert wrong != pytest.approx(areas @ off, rel=1e-4)


def test_columns_of_the_view_basis_count_as_long_as_they_are(rng):
    part = make_part(rng, "cta")
    part = replace(part, view_basis=rng.normal(size=part.view_basis.shape).astype(np.float32))
    after = rounded(part, peak_scales(part, 7))
    areas = np.ones(part.n_vertices)
    off = ((dense(after) - dense(part)) ** 2).sum()
    assert rounding_error(part, after, areas).factors == pytest.approx(off, rel=1e-9)


def test_equal_parts_differ_by_nothing(rng):
    part = make_part(rng, "cta")
    assert rounding_error(part, part, np.ones(part.n_vertices)) == (0.0, 0.0)


def test_a_rounding_of_1e_7_is_measured_beside_a_signal_of_1e8(rng):
    """Differences are taken before they are squared, so nothing cancels."""
    part = make_part(rng, "cpca")
    part = replace(part, means=(part.means * 1e8).astype(np.float32))
    weights = part.weights + np.float32(2.0**-20)
    after = with_factor(part, "weights", weights)
    off = after.weights.astype(np.float64) - part.weights
    expected = sum(
        float(np.sum((row @ part.components[label].astype(np.float64)) ** 2))
        for row, label in zip(off, part.labels, strict=True)
    )
    found = rounding_error(part, after, np.ones(part.n_vertices)).factors
    assert found == pytest.approx(expected, rel=1e-6)


def test_weights_of_texels_are_their_solid_angles():
    """Against triangles spanned by the directions of the texels' corners, Van Oosterom's formula."""
    resolution = 24
    at = np.linspace(0.0, 1.0, resolution + 1)
    corners = hemi_octahedral_inverse(np.stack(np.meshgrid(at, at), axis=-1))

    def solid_angle(a, b, c):
        triple = np.abs(np.einsum("...i,...i->...", a, np.cross(b, c)))
        dots = [np.einsum("...i,...i->...", x, y) for x, y in ((a, b), (b, c), (c, a))]
        return 2.0 * np.arctan2(triple, 1.0 + sum(dots))

    a, b, c, d = corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:]
    angles = solid_angle(a, b, c) + solid_angle(b, c, d)
    assert angles.sum() == pytest.approx(2.0 * np.pi, rel=1e-9)
    z = (a + b + c + d)[..., 2] / np.linalg.norm(a + b + c + d, axis=-1)
    expected = angles * z**2
    off = np.abs(cosine_weights(resolution) - expected)
    # the middle of a texel for all of it: 5 % off where it lies across an edge of the octahedron
    assert off.max() < 0.05 * expected.max()
    across = np.eye(resolution, dtype=bool) | np.eye(resolution, dtype=bool)[::-1]
    assert off[~across].max() < 0.01 * expected.max()
    uniform = np.full((resolution, resolution), expected.mean())
    assert np.abs(cosine_weights(resolution) - uniform).max() > 0.2 * expected.max()


@pytest.mark.parametrize("channels", [1, 3])
def test_the_texture_is_off_by_as_much_radiance(rng, channels):
    """Against the radiance of every vertex and texel."""
    part = make_part(rng, "cta", n_verts=60, n_channels=channels)
    texture = part.view_texture + 0.01 * rng.normal(size=part.view_texture.shape)
    after = with_factor(part, "view_texture", texture)
    areas = rng.uniform(0.1, 3.0, part.n_vertices)
    # no view basis: radiance is phi' times view columns
    columns = dense(replace(part, view_basis=np.eye(part.n_view, dtype=np.float32)))
    if channels == 1:
        columns = np.repeat(columns, 3, axis=1)
    off = (after.view_texture.astype(np.float64) - part.view_texture).reshape(-1, part.n_view, 3)
    radiance = np.einsum("trc,vcrl->vtcl", off, columns)
    expected = np.einsum(
        "v,t,vtcl->", areas, cosine_weights(12).ravel(), radiance**2, optimize=True
    )
    found = rounding_error(part, after, areas)
    assert found.texture == pytest.approx(expected, rel=1e-9)
    assert found.factors == 0.0


@pytest.mark.parametrize(("method", "channels"), KINDS)
def test_steps_foresee_the_error_of_each_factor(rng, method, channels):
    """s^2 / 12 for every number, each by its weight: within 10 %, factor by factor."""
    found, total, even = {}, np.zeros(2), {}
    # a basis has some 70 numbers that matter: the errors of several are added
    for _ in range(8):
        part = make_part(rng, method, n_verts=200, n_channels=channels)
        areas = rng.uniform(0.1, 3.0, part.n_vertices)
        weights, scales = number_weights(part, areas), peak_scales(part, 9)
        after = rounded(part, scales)
        for name in scales:
            alone = replace(part, **{name: getattr(after, name)})
            none = {other: scales[other] * (other == name) for other in scales}
            sums = found.setdefault(name, np.zeros(2))
            sums += rounding_error(part, alone, areas).total, foreseen_error(part, none, weights)
        total += rounding_error(part, after, areas).total, foreseen_error(part, scales, weights)
        # negative twin: every number as heavy as a weight
        same = {name: np.full_like(own, areas.mean()) for name, own in weights.items()}
        for name in scales:
            none = {other: scales[other] * (other == name) for other in scales}
            even[name] = even.get(name, 0.0) + foreseen_error(part, none, same)
    for name, (error, foreseen) in found.items():
        assert foreseen == pytest.approx(error, rel=0.1), name
    assert total[1] == pytest.approx(total[0], rel=0.1)
    off = [abs(np.log(even[name] / error)) for name, (error, _) in found.items()]
    assert max(off) > 0.5
