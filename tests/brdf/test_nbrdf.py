import math
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from prtbake_storage.contract.brdf_fits import DenseLayer, NbrdfSpec
from prtbake_workers.brdf.checks import check_reciprocity, directional_albedo
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.nbrdf import CHUNK, MAX_OUTPUT, Layer, Nbrdf
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.brdf.symmetrised import Symmetrised


def random_layers(seed=0, widths=(6, 21, 21, 3), scale=0.5):
    rng = np.random.default_rng(seed)
    return tuple(
        Layer(scale * rng.standard_normal((n, m)), scale * rng.standard_normal(m))
        for n, m in pairwise(widths)
    )


def spec_of(layers):
    return NbrdfSpec(
        layers=tuple(
            DenseLayer(weights=layer.weights.tolist(), biases=layer.biases.tolist())
            for layer in layers
        )
    )


def by_hand(layers, wi, wo):
    """One pair: angles, unit vectors from them, neurons one by one."""
    h = (wi + wo) / np.linalg.norm(wi + wo)
    theta_h, phi_h = math.acos(h[2]), math.atan2(h[1], h[0])
    c, s = math.cos(-phi_h), math.sin(-phi_h)
    x, y, z = wi[0] * c - wi[1] * s, wi[0] * s + wi[1] * c, wi[2]
    c, s = math.cos(-theta_h), math.sin(-theta_h)
    signal = [math.sin(theta_h), 0.0, math.cos(theta_h), x * c + z * s, y, z * c - x * s]
    for number, layer in enumerate(layers):
        out = [
            sum(x * w for x, w in zip(signal, column, strict=True)) + bias
            for column, bias in zip(layer.weights.T, layer.biases, strict=True)
        ]
        signal = out if number == len(layers) - 1 else [max(0.0, x) for x in out]
    return [max(0.0, math.exp(y) - 1.0) for y in signal]


def test_it_is_the_network_of_the_description(directions):
    layers = random_layers()
    wi, wo = directions(50), directions(50, seed=2)
    got = Nbrdf(layers).eval_brdf(wi, wo)
    plain = [by_hand(layers, a, b) for a, b in zip(wi, wo, strict=True)]
    np.testing.assert_allclose(got, plain, rtol=1e-10, atol=1e-12)
    assert (got > 0).any()
    assert (got == 0).any()


def test_a_network_of_zeros_is_diffuse():
    layers = random_layers(scale=0.0)
    biases = np.log1p(np.array([0.7, 0.4, 0.1]) / np.pi)
    flat = Nbrdf((*layers[:2], Layer(layers[2].weights, biases)))
    albedo = directional_albedo(flat, np.array([0.3, 1.0]))
    np.testing.assert_allclose(albedo, np.tile([0.7, 0.4, 0.1], (2, 1)), rtol=1e-12)


def test_chunks_join(directions):
    nbrdf = Nbrdf(random_layers())
    wi, wo = directions(CHUNK + 5), directions(CHUNK + 5, seed=2)
    whole = nbrdf.eval_brdf(wi, wo)
    # products of another shape round differently
    np.testing.assert_allclose(whole[-3:], nbrdf.eval_brdf(wi[-3:], wo[-3:]), rtol=1e-12)


def test_an_output_that_would_overflow_is_held():
    layers = random_layers(scale=0.0)
    loud = Nbrdf((*layers[:2], Layer(layers[2].weights, np.array([1e6, -1e6, 0.0]))))
    up = np.array([[0.0, 0.0, 1.0]])
    np.testing.assert_allclose(loud.eval_brdf(up, up), [[np.expm1(MAX_OUTPUT), 0.0, 0.0]])


def test_the_registered_network_is_symmetric_and_factorises(directions):
    layers = random_layers(seed=1, scale=0.3)
    brdf = brdf_from_spec(spec_of(layers))
    assert isinstance(brdf, Symmetrised)
    assert not check_reciprocity(Nbrdf(layers)).reciprocal
    assert check_reciprocity(brdf).max_relative == 0.0
    assert factorise(brdf, n_terms=16, n_nodes=65).energy_lost < 0.5
    wi, wo = directions(20), directions(20, seed=2)
    np.testing.assert_allclose(
        brdf.original.eval_brdf(wi, wo), Nbrdf(layers).eval_brdf(wi, wo), rtol=1e-15
    )


@pytest.mark.parametrize(
    ("widths", "says"),
    [
        ((6, 21, 21, 1), "gives 1 numbers"),
        ((5, 21, 21, 3), "layer 0 takes 5 numbers where 6"),
        ((6, 65, 21, 3), "at most 64"),
    ],
)
def test_networks_of_another_shape_are_refused(widths, says):
    with pytest.raises(ValidationError, match=says):
        spec_of(random_layers(widths=widths))


def test_a_ragged_layer_is_refused():
    with pytest.raises(ValidationError, match="row 1 of the weights has 1 numbers beside 2"):
        DenseLayer(weights=((1.0, 2.0), (1.0,)), biases=(0.0, 0.0))
    with pytest.raises(ValidationError, match="exceeds 1e6"):
        DenseLayer(weights=((1.0, 2e6),), biases=(0.0, 0.0))
