"""Figure 7's comparison at a small size: both ways to the exit radiance, and what they are held to."""

import numpy as np
import pytest

from figures.comparison import FITTED, Sizes, Tally, compare, view_measures
from figures.exit_radiance import (
    Points,
    brdf_matrix,
    hemisphere_rule,
    incident_light,
    reflection_kernel,
    transfer,
    vertex_points,
)
from figures.figure7 import BRDFS, lights, main
from figures.projections import (
    COMPARED,
    LEAST_16,
    ZERO_25,
    Projection,
    exit_functions,
    project,
    transfer_matrices,
)
from prtbake_workers.basis.sh import HemisphereBasis, eval_sh, glossy_matrix
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.geometry.teapot import teapot
from prtbake_workers.transport.directions import cube_directions
from support.quadrature import hemisphere_quadrature, sphere_quadrature

SMALL = Sizes(
    reference=(24, 96), coarser=(16, 60), brdf=(24, 128), views=(6, 16), cube=16, supersample=2, block=8
)  # fmt: skip
HIGH_WALL = 1e4


@pytest.fixture(scope="module")
def corner():
    """A point before a wall in the plane z = -0.01 that covers half of its sky, and the wall."""
    normal = np.array([[0.0, 1.0, 0.0]])
    points = Points(np.zeros((1, 3), np.float32), tangent_frames(normal), np.ones(1))
    reach, z = HIGH_WALL, -0.01
    wall = np.array([[-reach, -1.0, z], [reach, -1.0, z], [reach, reach, z], [-reach, reach, z]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return points, Accelerator(wall, faces)


@pytest.fixture(scope="module")
def oracle_rule():
    """Gauss-Legendre in azimuth over the half of the hemisphere that faces away from the wall."""
    z, phi = (np.polynomial.legendre.leggauss(n) for n in (60, 80))
    cosine, cosine_weights = 0.5 * (z[0] + 1.0), 0.5 * z[1]
    angle, angle_weights = 0.5 * np.pi * phi[0], 0.5 * np.pi * phi[1]
    cosine, angle = (a.ravel() for a in np.meshgrid(cosine, angle, indexing="ij"))
    sine = np.sqrt(1.0 - cosine**2)
    # in the world: y is the normal and +z points away from the wall
    world = np.stack([sine * np.sin(angle), cosine, sine * np.cos(angle)], axis=1)
    return world, np.outer(cosine_weights, angle_weights).ravel()


@pytest.fixture(scope="module")
def teapot_points():
    mesh = teapot(6)
    scene = Scene.from_parts([mesh])
    vertices = np.random.default_rng(3).permutation(mesh.n_vertices)[:24]
    return vertex_points(scene, vertices), Accelerator(scene.positions, scene.faces)


@pytest.fixture(scope="module")
def tallies(teapot_points):
    points, accelerator = teapot_points
    brdfs = {n: brdf_from_spec(BRDFS[n]) for n in ("GGX, alpha 0.3", "Phong, exponent 64")}
    return compare(points, accelerator, brdfs, SMALL)


def half_sky_radiance(brdf, frame, views, oracle_rule):
    """Exit radiance beside the wall under every y_j, its visibility known in closed form."""
    world, weights = oracle_rule
    local = world @ frame.T
    rho = brdf.eval_brdf(local[None], views[:, None])[..., 0]
    return (rho * (weights * local[:, 2])) @ eval_sh(5, world)


def relative(difference, signal):
    return np.linalg.norm(difference) / np.linalg.norm(signal)


@pytest.mark.parametrize("name", ["Phong, exponent 16", "GGX, alpha 0.3"])
def test_reference_equals_integration_over_the_visible_half(name, corner, oracle_rule):
    points, accelerator = corner
    brdf = brdf_from_spec(BRDFS[name])
    views, _ = hemisphere_rule(6, 16)
    expected = half_sky_radiance(brdf, points.frames[0], views, oracle_rule)
    rule = hemisphere_rule(40, 256, turn=0.5)
    seen = incident_light(points, accelerator, rule, 5)
    operator = (reflection_kernel(brdf, views, rule) @ seen)[0]
    # 1 %: the wall's foot hides 1e-4 of the sky on the wrong side, a ring has 256 points
    assert relative(operator - expected, expected) < 0.01
    # negative twins: without the wall; with the frame turned the other way
    unoccluded = reflection_kernel(brdf, views, rule) @ eval_sh(5, rule[0] @ points.frames[0])
    assert relative(unoccluded - expected, expected) > 0.2
    turned = Points(points.origins, points.frames.swapaxes(1, 2).copy(), points.areas)
    wrong = reflection_kernel(brdf, views, rule) @ incident_light(turned, accelerator, rule, 5)
    assert relative(wrong[0] - expected, expected) > 0.2


def test_matrices_approach_the_same_integral_as_orders_rise(corner, oracle_rule):
    """Least squares on 8 bands of a blunt lobe: what is left is small, and smaller than on 4."""
    points, accelerator = corner
    brdf = brdf_from_spec(BRDFS["Phong, exponent 4"])
    views, _ = hemisphere_rule(6, 16)
    expected = half_sky_radiance(brdf, points.frames[0], views, oracle_rule)
    matrix = brdf_matrix(brdf, 8, 24, 128)
    t = transfer(points, accelerator, cube_directions(32), 8, 5, supersample=2)
    errors = []
    for order in (4, 8):
        projection = Projection("", order, order, "least_squares", "least_squares")
        m = transfer_matrices(projection, matrix, t, points.frames)[0]
        errors.append(relative(exit_functions(projection, views) @ m - expected, expected))
    assert errors[0] < 0.1
    # 0.01: the cube's texels cut the wall's edge in steps
    assert errors[1] < 0.01


def test_least_squares_is_the_library_glossy_matrix(teapot_points):
    points, accelerator = teapot_points
    brdf = brdf_matrix(brdf_from_spec(BRDFS["Phong, exponent 16"]), 5, 16, 40)
    t = transfer(points, accelerator, cube_directions(8), 5, 5)
    incident, exitant = HemisphereBasis(5), HemisphereBasis(4)
    expected = exitant.complete(
        glossy_matrix(
            brdf[:16], t, points.frames, incident=incident, exitant=exitant
        ).swapaxes(1, 2)
    ).swapaxes(1, 2)  # fmt: skip
    matrices = transfer_matrices(LEAST_16, brdf, t, points.frames)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(matrices, expected, rtol=0, atol=1e-10 * scale)
    # negative twin: A^-1 on one side only
    one_sided = Projection("", 4, 5, "least_squares", "zero")
    assert (
        np.abs(transfer_matrices(one_sided, brdf, t, points.frames) - expected).max() > 0.01 * scale
    )


@pytest.mark.parametrize(("method", "below"), [("zero", 0.0), ("odd", -1.0), ("even", 1.0)])
def test_projections_are_those_of_the_continued_function(method, below):
    """Continue a function below the horizon by hand and project it on the sphere."""
    directions, weights = hemisphere_quadrature(12)
    signal = np.exp(directions[:, 0]) + directions[:, 2]
    values = eval_sh(5, directions)
    integrals = (weights * signal) @ values
    mirrored = (weights * signal) @ eval_sh(5, directions * [1.0, 1.0, -1.0])
    coefficients = project(5, method, integrals)
    np.testing.assert_allclose(coefficients, integrals + below * mirrored, rtol=0, atol=1e-13)
    other = {"zero": "even", "odd": "even", "even": "odd"}[method]
    assert np.abs(project(5, other, integrals) - coefficients).max() > 0.1


def test_stored_rows_are_those_of_the_names():
    for projection in COMPARED:
        assert len(projection.kept) == int(projection.name.split()[0])
        assert projection.n_bytes(25) == 4 * 25 * len(projection.kept)


def test_claim_of_the_figure_holds_for_a_lobe_with_fresnel(tallies):
    """16 x 25 least squares against 25 x 25 zero-hemisphere, GGX; at silhouettes above all."""
    of = tallies["GGX, alpha 0.3"]
    for measure in ("cosine", "solid angle", "silhouette"):
        least, zero = (of[p.name].relative(of["reference"], measure) for p in (LEAST_16, ZERO_25))
        # 0.081 to 0.149, 0.133 to 0.268 and 0.205 to 0.441 at full size
        assert least < 0.7 * zero
        # negative twin: with the same 16 rows and no A^-1 it does not
        plain = of["16 x 25 zero-hemisphere"].relative(of["reference"], measure)
        assert plain > zero


def test_and_fails_at_silhouettes_of_a_sharp_lobe_without(tallies):
    """Phong fades there: four bands fitted where it is bright ring where it is dark."""
    of = tallies["Phong, exponent 64"]
    least, zero = (of[p.name].relative(of["reference"], "silhouette") for p in (LEAST_16, ZERO_25))
    assert least > 1.3 * zero  # 1.21 to 0.73 at full size
    least, zero = (of[p.name].relative(of["reference"], "cosine") for p in (LEAST_16, ZERO_25))
    assert least < zero


def test_no_sixteen_functions_do_better_by_solid_angle(tallies):
    for of in tallies.values():
        fitted = of[FITTED].relative(of["reference"], "solid angle")
        for projection in COMPARED:
            if projection.exitant == 4:
                error = of[projection.name].relative(of["reference"], "solid angle")
                assert error > (1.0 - 1e-6) * fitted


@pytest.fixture(scope="module")
def lit():
    return lights()


def test_tally_gives_the_errors_of_single_lights(rng, lit):
    """Against sums over points, views and channels written out."""
    views, weights = hemisphere_rule(4, 8, breaks=(0.0, 0.25, 1.0))
    measures = view_measures(views, weights)
    assert weights.sum() == pytest.approx(2.0 * np.pi)
    # the area of a zone is 2 pi times its height: the break makes it exact
    assert measures["silhouette"].sum() == pytest.approx(0.5 * np.pi)
    exact, error = rng.normal(size=(2, 5, len(views), 25))
    error[3:] = 0.0
    areas = rng.uniform(1.0, 2.0, 5)
    reference, tally = Tally(), Tally()
    for block in (slice(0, 2), slice(2, 5)):
        reference.add(exact[block], areas[block], measures)
        tally.add(error[block], areas[block], measures)
    for light in lit.values():
        squares = [
            sum(
                area * weight * np.sum((row @ light) ** 2)
                for area, operator in zip(areas, operators, strict=True)
                for weight, row in zip(measures["cosine"], operator, strict=True)
            )
            for operators in (error, exact)
        ]
        expected = np.sqrt(squares[0] / squares[1])
        assert tally.relative(reference, "cosine", light) == pytest.approx(expected, rel=1e-9)
        assert tally.relative(reference, "solid angle", light) != pytest.approx(expected, rel=1e-3)
    at_silhouettes = np.einsum("p,v,pvj->", areas, measures["silhouette"], exact**2)
    everywhere = np.einsum("p,v,pvj->", areas, weights, exact**2)
    assert reference.silhouette_share() == pytest.approx(at_silhouettes / everywhere)
    share = tally.better_share(reference, reference, areas)
    squares = [np.einsum("v,pvj->p", measures["cosine"], x**2) for x in (error, exact)]
    assert share == pytest.approx(areas @ (squares[0] < squares[1]) / areas.sum())


def test_lamps_are_nowhere_negative_and_cut_off_at_nothing(lit):
    directions, weights = sphere_quadrature(12)
    lamps = eval_sh(5, directions) @ lit["lamps"]
    assert lamps.min() > -1e-12
    power = (weights @ lamps**2).sum()
    assert power == pytest.approx(np.sum(lit["lamps"] ** 2), rel=1e-12)


def test_command_prints_and_writes_tables_and_picture(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("PRTBAKE_DATA", raising=False)
    sizes = Sizes((8, 32), (6, 24), (8, 32), (4, 16), 4, 1, 8)
    arguments = ["--to", str(tmp_path), "--vertices", "4", "--tessellation", "4", "--width", "16"]
    assert main(arguments, sizes) == 0
    text = (tmp_path / "figure7.md").read_text()
    assert capsys.readouterr().out == text
    assert text.count("## teapot") == len(BRDFS)
    assert text.count(f"| {LEAST_16.name} ") == len(BRDFS)
    assert (tmp_path / "figure7.png").read_bytes().startswith(b"\x89PNG")
