"""Product quadratures of the sphere and the hemisphere, and re-projection by them."""

import numpy as np


def sphere_quadrature(n):
    """Gauss-Legendre in z, even in phi: exact for polynomials of degree below 2 n."""
    return _product(*np.polynomial.legendre.leggauss(n))


def hemisphere_quadrature(n):
    """The same over z >= 0."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return _product(0.5 * (nodes + 1.0), 0.5 * weights)


def _product(z, weights):
    n = len(z)
    phi = 2 * np.pi * np.arange(2 * n) / (2 * n)
    z, phi = np.meshgrid(z, phi, indexing="ij")
    sine = np.sqrt(1 - z**2)
    directions = np.stack([sine * np.cos(phi), sine * np.sin(phi), z], axis=-1).reshape(-1, 3)
    return directions, np.repeat(weights * np.pi / n, 2 * n)


def random_directions(rng, n):
    directions = rng.normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)
