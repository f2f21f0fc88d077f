"""The numpy decode against dense tensors, closed forms and turned scenes."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.decode.asset import Asset, Part, check_asset
from prtbake_storage.decode.light import LightFit
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.decode.relight import (
    cluster_matrices,
    project_light,
    relight,
    rotation_matrix,
    shade,
    vertex_radiance,
)
from prtbake_storage.decode.srbf import gaussian, whitening
from prtbake_storage.decode.transfer_basis import WhitenedSrbfs
from prtbake_storage.decode.view_map import hemi_octahedral, lookup
from support.means import with_means
from support.quadrature import sphere_quadrature


def unit(rng: np.random.Generator, n: int) -> np.ndarray:
    vectors = rng.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def fibonacci(n: int) -> np.ndarray:
    """Even directions, each standing for 4 pi / n steradians."""
    i = np.arange(n) + 0.5
    z = 1 - 2 * i / n
    angle = np.pi * (1 + 5**0.5) * i
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], 1)


def smooth_light(rng: np.random.Generator, n: int = 5) -> LightFit:
    return LightFit(
        centres=unit(rng, n), bandwidths=rng.uniform(1.0, 6.0, n), coefficients=rng.random((n, 3))
    )


def sphere_asset(normals: np.ndarray) -> Asset:
    """Unshadowed Lambertian points: whitened transfer in full, as CPCA with one empty component."""
    centres, bandwidth = fibonacci(200), 16.0
    directions = fibonacci(6000)
    cosine = np.maximum(normals @ directions.T, 0.0) / np.pi * (4 * np.pi / len(directions))
    overlap = cosine @ gaussian(directions @ centres.T, bandwidth)
    transfer = (overlap @ whitening(centres, bandwidth).inv_sqrt_gram).astype(np.float32)
    n = len(normals)
    part = Part(
        name="object", vertex_range=(0, n), material={"model": "lambert"}, method="cpca",
        labels=np.arange(n, dtype=np.int32), weights=np.zeros((n, 1), np.float32), means=transfer,
        components=np.zeros((n, 1, 200), np.float32), ranks=np.ones((n, 3), np.int32),
        albedo=np.array([0.5], np.float32),
    )  # fmt: skip
    return Asset(
        positions=normals.astype(np.float32), faces=np.zeros((1, 3), np.int32),
        normals=normals.astype(np.float32), uv=None, parts=(part,),
        basis=WhitenedSrbfs(centres, bandwidth),
    )  # fmt: skip


def irradiance_over_pi(normals: np.ndarray, light: LightFit, rotation: np.ndarray) -> np.ndarray:
    """The same by quadrature of the light itself: L'(d) = L(R^T d)."""
    directions = fibonacci(20_000)
    kernel = gaussian((directions @ rotation) @ light.centres.T, light.bandwidths)
    radiance = kernel @ light.coefficients
    cosine = np.maximum(normals @ directions.T, 0.0)
    return cosine @ radiance * 4 / len(directions)


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (33.0, -70.0, 121.0)])
def test_a_projected_light_is_the_integral_of_basis_and_radiance(
    rng: np.random.Generator, angles: tuple[float, float, float]
) -> None:
    """L'(d) = L(R^T d) by quadrature: lobes wider than the basis, and narrower ones."""
    asset, rotation = sphere_asset(unit(rng, 2)), rotation_matrix(angles)
    light = LightFit(
        centres=unit(rng, 5),
        bandwidths=np.array([2.0, 8.0, 30.0, 60.0, 1.0]),
        coefficients=rng.normal(size=(5, 3)),
    )
    directions, weights = sphere_quadrature(80)
    kernel = gaussian((directions @ rotation) @ light.centres.T, light.bandwidths)
    flux = (kernel @ light.coefficients) * weights[:, None]
    basis = gaussian(directions @ asset.basis.centres.T, asset.basis.bandwidth)
    expected = whitening(asset.basis.centres, asset.basis.bandwidth).inv_sqrt_gram @ (
        basis.T @ flux
    )
    # 1e-9 of the largest: G^(-1/2) amplifies rounding by the root of the condition number
    atol = 1e-9 * np.abs(expected).max()
    np.testing.assert_allclose(
        project_light(asset.basis, light, rotation), expected, rtol=0, atol=atol
    )
    for wrong in (
        project_light(asset.basis, replace(light, bandwidths=light.bandwidths * 1.001), rotation),
        project_light(asset.basis, light, rotation @ rotation_matrix((0.0, 0.1, 0.0))),
    ):
        assert np.abs(wrong - expected).max() > 1e3 * atol


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.0, 90.0, 0.0), (33.0, -70.0, 121.0)])
def test_a_lambertian_sphere_reflects_its_irradiance(
    rng: np.random.Generator, angles: tuple[float, float, float]
) -> None:
    normals, light = unit(rng, 40), smooth_light(rng)
    asset = sphere_asset(normals)
    rotation = rotation_matrix(angles)
    (found,) = relight(asset, project_light(asset.basis, light, rotation))
    expected = irradiance_over_pi(normals, light, rotation)
    # 200 smooth SRBFs leave up to 1e-3 of a clamped cosine out of such a light
    tolerance = 3e-3 * expected.max()
    np.testing.assert_allclose(found[:, 0], expected, atol=tolerance)
    wrong = irradiance_over_pi(normals, light, rotation_matrix((0.0, 20.0, 0.0)) @ rotation)
    assert np.abs(found[:, 0] - wrong).max() > 3 * tolerance


def test_turning_the_light_is_turning_the_sphere_back(rng: np.random.Generator) -> None:
    normals, light = unit(rng, 40), smooth_light(rng)
    rotation = rotation_matrix((20.0, 50.0, -30.0))
    still, turned = sphere_asset(normals), sphere_asset(normals @ rotation)  # rows R^T n
    (by_light,) = relight(still, project_light(still.basis, light, rotation))
    (by_asset,) = relight(turned, project_light(turned.basis, light))
    tolerance = 3e-3 * by_light.max()  # the basis itself does not turn, see above
    np.testing.assert_allclose(by_light, by_asset, atol=tolerance)
    (backwards,) = relight(still, project_light(still.basis, light, rotation.T))
    assert np.abs(backwards - by_asset).max() > 3 * tolerance


def test_rotations_turn_about_x_then_y_then_z() -> None:
    x, y, z = np.eye(3)
    np.testing.assert_allclose(rotation_matrix((0, 0, 90)) @ x, y, atol=1e-15)
    np.testing.assert_allclose(rotation_matrix((90, 0, 0)) @ y, z, atol=1e-15)
    np.testing.assert_allclose(rotation_matrix((0, 90, 0)) @ z, x, atol=1e-15)
    np.testing.assert_allclose(rotation_matrix((90, 90, 0)) @ y, x, atol=1e-15)
    np.testing.assert_allclose(rotation_matrix((0, 90, 90)) @ z, y, atol=1e-15)


def dense_transfer(part: Part, vertex: int) -> np.ndarray:
    """T_x (terms, coeffs) by [Tsai2006] eq. (18), written out."""
    cluster = part.labels[vertex]
    dual, bases = part.dual_bases, part.light_bases
    assert dual is not None
    assert bases is not None
    core = (dual[cluster].T.astype(np.float64) @ part.weights[vertex]).reshape(part.n_view, -1)
    return part.view_basis @ core @ bases[cluster].T


def test_cta_equals_the_dense_tensor(asset: Asset, rng: np.random.Generator) -> None:
    part = asset.parts[0]
    light = rng.normal(size=(asset.n_coeffs, 3))
    found = vertex_radiance(part, cluster_matrices(part, light))
    expected = np.stack(
        [
            np.linalg.lstsq(part.view_basis, dense_transfer(part, v) @ light)[0]
            for v in range(part.n_vertices)
        ]
    )
    # float32 sums of products of order 10
    np.testing.assert_allclose(found, expected, atol=3e-5 * np.abs(expected).max())
    swapped = replace(part, labels=(part.labels + 1) % part.n_clusters)
    other = vertex_radiance(swapped, cluster_matrices(swapped, light))
    assert np.abs(other - expected).max() > 0.1 * np.abs(expected).max()


def test_cpca_equals_mean_plus_components(asset: Asset, rng: np.random.Generator) -> None:
    part = asset.parts[1]
    assert part.means is not None
    assert part.components is not None
    light = rng.normal(size=(asset.n_coeffs, 3))
    found = vertex_radiance(part, cluster_matrices(part, light))
    transfer = part.means[part.labels] + np.einsum(
        "vp,vpc->vc", part.weights, part.components[part.labels]
    )
    expected = transfer @ light
    np.testing.assert_allclose(found[:, 0], expected, atol=3e-5 * np.abs(expected).max())


@pytest.mark.parametrize("method", ["vq", "pca", "cpca"])
@pytest.mark.parametrize("n_channels", [1, 3])
def test_means_of_several_terms_are_those_of_each_written_out(
    asset: Asset, coloured: Asset, rng: np.random.Generator, method: str, n_channels: int
) -> None:
    own = coloured if n_channels == 3 else asset
    part = with_means(own.parts[0], method, own.n_coeffs, rng)
    check_asset(replace(own, parts=(part, own.parts[1])))
    assert part.means is not None
    assert part.components is not None
    assert part.n_view == 3
    signal = part.means[part.labels] + np.einsum(
        "vp,vpd->vd", part.weights, part.components[part.labels]
    )
    expected = signal.reshape(part.n_vertices, n_channels * 3, own.n_coeffs)
    found = reconstruct(part, slice(None))
    # float32 sums of two products
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_array_equal(reconstruct(part, slice(7, 11)), found[7:11])
    light = rng.normal(size=(own.n_coeffs, 3))
    by_channel = np.broadcast_to(
        expected.reshape(part.n_vertices, n_channels, 3, -1), (part.n_vertices, 3, 3, own.n_coeffs)
    )
    product = np.einsum("vckl,lc->vkc", by_channel, light)
    lit = vertex_radiance(part, cluster_matrices(part, light))
    atol = 3e-5 * np.abs(product).max()
    np.testing.assert_allclose(lit, product, rtol=0, atol=atol)
    # negative twin: coefficients before terms
    turned = part.means.reshape(len(part.means), n_channels, 3, -1).swapaxes(2, 3)
    other = replace(part, means=np.ascontiguousarray(turned).reshape(part.means.shape))
    mixed = vertex_radiance(other, cluster_matrices(other, light))
    assert np.abs(mixed - product).max() > 1e3 * atol


def test_a_view_basis_mixes_the_view_columns_of_means(
    asset: Asset, rng: np.random.Generator
) -> None:
    """Files with a basis of their own decode too: T = U_view (mean + components)."""
    plain = with_means(asset.parts[0], "cpca", asset.n_coeffs, rng)
    basis = np.linalg.qr(rng.normal(size=(6, 3)))[0].astype(np.float32)
    part = replace(plain, view_basis=basis)
    check_asset(replace(asset, parts=(part, asset.parts[1])))
    expected = basis @ reconstruct(plain, slice(None))
    np.testing.assert_allclose(reconstruct(part, slice(None)), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"components": None}, "parts/0: cpca needs components"),
        ({"method": "cta"}, "parts/0: cta needs light_bases and dual_bases"),
        ({"method": "vq"}, "parts/0/weights: vq has none, not 2 a vertex"),
        ({"light_bases": np.ones((4, 42, 2), np.float32)}, "exclude each other"),
        ({"means": np.ones((4, 42), np.float32)}, r"means has shape \(4, 42\), not \(4, 126\)"),
        ({"components": np.ones((4, 3, 126), np.float32)}, r"components has shape \(4, 3, 126\)"),
        (
            {"components": np.full((4, 2, 126), np.inf, np.float32)},
            r"components is not finite at \(0, 0, 0\)",
        ),
    ],
)
def test_factors_that_do_not_belong_together_are_named(
    asset: Asset, rng: np.random.Generator, changes: dict[str, object], message: str
) -> None:
    part = with_means(asset.parts[0], "cpca", asset.n_coeffs, rng)
    check_asset(replace(asset, parts=(part, asset.parts[1])))
    broken = replace(asset, parts=(replace(part, **changes), asset.parts[1]))
    with pytest.raises(ValueError, match=message):
        check_asset(broken)


def in_equal_channels(part: Part) -> Part:
    """The same transfer for red, green and blue, with one set of weights."""
    dual, bases = part.dual_bases, part.light_bases
    factors: dict[str, np.ndarray] = {}
    if dual is not None and bases is not None:
        clusters, n_weights, _ = dual.shape
        rows = dual.reshape(clusters, n_weights, 1, part.n_view, bases.shape[2])
        factors["dual_bases"] = np.repeat(rows, 3, axis=2).reshape(clusters, n_weights, -1)
    if part.means is not None and part.components is not None:
        factors["means"] = np.tile(part.means, (1, 3))
        factors["components"] = np.tile(part.components, (1, 1, 3))
    return replace(part, n_channels=3, **factors)


def test_three_equal_channels_look_like_one(asset: Asset, rng: np.random.Generator) -> None:
    asset = facing(asset)
    light = rng.normal(size=(asset.n_coeffs, 3))
    coloured = replace(asset, parts=tuple(in_equal_channels(part) for part in asset.parts))
    check_asset(coloured)
    for one, three in zip(asset.parts, coloured.parts, strict=True):
        expected = reconstruct(one, slice(None))
        found = reconstruct(three, slice(None))
        # the same float32 products, in sums that another matrix product may order otherwise
        atol = 1e-6 * np.abs(expected).max()
        np.testing.assert_allclose(found, np.tile(expected, (1, 3, 1)), rtol=0, atol=atol)
    plain, lit = relight(asset, light), relight(coloured, light)
    for before, after in zip(plain, lit, strict=True):
        np.testing.assert_allclose(after, before, rtol=0, atol=1e-6 * np.abs(before).max())
    triangles = np.arange(len(asset.faces), dtype=np.int32)
    corners = asset.positions[asset.faces].astype(np.float64)
    eyes = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    eyes /= np.linalg.norm(eyes, axis=1, keepdims=True)
    query = (triangles, np.tile([0.2, 0.5, 0.3], (len(triangles), 1)), eyes)
    picture = shade(asset, plain, *query)
    assert np.count_nonzero(picture) == picture.size
    np.testing.assert_allclose(
        shade(coloured, lit, *query), picture, rtol=0, atol=1e-6 * np.abs(picture).max()
    )


def term_major(part: Part) -> Part:
    """The same numbers read as if a row were k * channels + c."""
    dual, bases = part.dual_bases, part.light_bases
    if dual is not None and bases is not None:
        clusters, n_weights, _ = dual.shape
        rows = dual.reshape(clusters, n_weights, part.n_view, 3, bases.shape[2])
        return replace(part, dual_bases=rows.swapaxes(2, 3).reshape(dual.shape))
    assert part.means is not None
    return replace(part, means=part.means.reshape(len(part.means), -1, 3).swapaxes(1, 2).reshape(
        part.means.shape))  # fmt: skip


@pytest.mark.parametrize("index", [0, 1], ids=["cta", "cpca"])
def test_each_channel_of_the_light_meets_its_own_transfer(
    coloured: Asset, rng: np.random.Generator, index: int
) -> None:
    part = coloured.parts[index]
    check_asset(coloured)
    light = rng.normal(size=(coloured.n_coeffs, 3))
    transfer = reconstruct(part, slice(None)).astype(np.float64)
    n_terms = len(part.view_basis)
    assert transfer.shape == (part.n_vertices, 3 * n_terms, coloured.n_coeffs)
    by_channel = transfer.reshape(part.n_vertices, 3, n_terms, -1)
    expected = np.einsum("vckl,lc->vkc", by_channel, light)
    lit = vertex_radiance(part, cluster_matrices(part, light))
    assert lit.shape == (part.n_vertices, part.n_view, 3)
    found = np.einsum("kr,vrc->vkc", part.view_basis, lit)
    # float32 sums of products of order 10
    atol = 3e-5 * np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)
    wrong = np.einsum("vckl,lc->vkc", by_channel, light[:, [1, 2, 0]])
    assert np.abs(found - wrong).max() > 1e3 * atol
    other = term_major(part)
    mixed = vertex_radiance(other, cluster_matrices(other, light))
    assert np.abs(np.einsum("kr,vrc->vkc", part.view_basis, mixed) - expected).max() > 1e3 * atol


def test_three_channels_of_cta_are_the_dense_tensor_of_each(coloured: Asset) -> None:
    """Eq. (18) of a channel's own rows of the dual basis, written out."""
    part = coloured.parts[0]
    assert part.dual_bases is not None
    assert part.light_bases is not None
    found = reconstruct(part, slice(None))
    n_terms, size = len(part.view_basis), part.n_view * part.light_bases.shape[2]
    for channel in range(3):
        dual = part.dual_bases[:, :, channel * size : (channel + 1) * size]
        alone = replace(part, n_channels=1, dual_bases=dual)
        expected = np.stack([dense_transfer(alone, v) for v in range(part.n_vertices)])
        rows = found[:, channel * n_terms : (channel + 1) * n_terms]
        atol = 1e-5 * np.abs(expected).max()
        np.testing.assert_allclose(rows, expected, rtol=0, atol=atol)
        others = found[:, channel::3]
        assert np.abs(others - expected).max() > 1e3 * atol


def test_channels_and_shapes_that_disagree_are_refused_by_name(coloured: Asset) -> None:
    glossy, diffuse = coloured.parts
    assert glossy.dual_bases is not None
    assert diffuse.components is not None
    for wrong, message in (
        (replace(glossy, n_channels=2), "parts/0/n_channels is 2"),
        (replace(glossy, n_channels=1), "parts/0/clusters/dual_bases has shape"),
        (replace(glossy, dual_bases=glossy.dual_bases[..., :30]), "parts/0/clusters/dual_bases"),
    ):
        with pytest.raises(ValueError, match=message):
            check_asset(replace(coloured, parts=(wrong, diffuse)))
    for wrong, message in (
        (replace(diffuse, n_channels=0), "parts/1/n_channels is 0"),
        (replace(diffuse, n_channels=1), "parts/1/clusters/means has shape"),
        (replace(diffuse, components=diffuse.components[..., :42]), "parts/1/clusters/components"),
    ):
        with pytest.raises(ValueError, match=message):
            check_asset(replace(coloured, parts=(glossy, wrong)))


def facing(asset: Asset) -> Asset:
    """Give every triangle one normal a corner that agrees with its winding."""
    a, b, c = (asset.positions[asset.faces[:, i]].astype(np.float64) for i in range(3))
    up = np.cross(b - a, c - a)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    normals = asset.normals.astype(np.float64)
    for corner in range(3):
        at = asset.faces[:, corner]
        normals[at] *= np.sign(np.einsum("ni,ni->n", normals[at], up))[:, None]
    return replace(asset, normals=normals.astype(np.float32))


def test_colours_of_corners_are_mixed_each_in_its_own_frame(
    asset: Asset, rng: np.random.Generator
) -> None:
    asset = facing(asset)
    radiances = relight(asset, rng.normal(size=(asset.n_coeffs, 3)))
    part, radiance = asset.parts[0], radiances[0]
    assert part.view_texture is not None
    assert part.frames is not None
    triangle = 3
    corners = asset.faces[triangle]
    a, b, c = asset.positions[corners].astype(np.float64)
    wo = np.cross(b - a, c - a)
    wo /= np.linalg.norm(wo)
    weights = np.array([0.2, 0.5, 0.3])
    expected = np.zeros(3)
    for corner, weight in zip(corners, weights, strict=True):
        uv = hemi_octahedral((part.frames[corner] @ wo)[None])
        phi = lookup(part.view_texture, uv)[0]
        expected += weight * (phi * radiance[corner]).sum(axis=0)
    query = (np.array([triangle, -1, triangle]), np.tile(weights, (3, 1)), np.array([wo, wo, -wo]))
    found = shade(asset, radiances, *query)
    # float32 throughout
    np.testing.assert_allclose(found[0], expected, atol=1e-5 * np.abs(expected).max())
    assert (found[1:] == 0).all()
    mixed = np.einsum("c,cij->ij", weights, part.frames[corners].astype(np.float64))
    phi = lookup(part.view_texture, hemi_octahedral((mixed @ wo)[None]))[0]
    one_frame = (phi * np.einsum("c,crx->rx", weights, radiance[corners])).sum(axis=0)
    assert np.abs(one_frame - expected).max() > 0.01 * np.abs(expected).max()


def test_albedo_and_texture_multiply_at_the_pixel(asset: Asset, rng: np.random.Generator) -> None:
    asset = facing(asset)
    radiances = relight(asset, rng.normal(size=(asset.n_coeffs, 3)))
    triangle = len(asset.faces) - 1
    corners = asset.faces[triangle]
    a, b, c = asset.positions[corners].astype(np.float64)
    wo = np.cross(b - a, c - a)
    query = (np.array([triangle]), np.array([[0.2, 0.5, 0.3]]), wo[None] / np.linalg.norm(wo))
    plain = replace(asset, parts=(asset.parts[0], replace(asset.parts[1], albedo_texture=None)))
    white = np.full((2, 2, 3), [0.5, 1.0, 0.25], np.float32)
    tinted = replace(asset, parts=(asset.parts[0], replace(asset.parts[1], albedo_texture=white)))
    base, found = shade(plain, radiances, *query), shade(tinted, radiances, *query)
    np.testing.assert_allclose(found, base * [0.5, 1.0, 0.25], rtol=1e-6)
    local = corners - asset.parts[1].vertex_range[0]
    np.testing.assert_allclose(base[0], 0.7 * (query[1][0] @ radiances[1][local, 0]), rtol=1e-5)
