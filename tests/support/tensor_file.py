"""Tensor files by the format's description, and a GGX surface in them."""

import struct
from functools import cache

import numpy as np

CODES = {"u1": 1, "f4": 10, "f8": 11, "u4": 5}


def tensor_bytes(fields, *, version=(1, 0), signature=b"tensor_file\0"):
    """Encode arrays; the data follow the headers, each at a multiple of eight."""
    arrays = {name: np.ascontiguousarray(array) for name, array in fields.items()}
    size = len(signature) + 2 + 4
    size += sum(2 + len(name) + 2 + 1 + 8 + 8 * array.ndim for name, array in arrays.items())
    head = signature + bytes(version) + struct.pack("<I", len(arrays))
    body, at = b"", size
    for name, array in arrays.items():
        pad = -at % 8
        head += struct.pack("<H", len(name)) + name.encode()
        head += struct.pack("<HBQ", array.ndim, CODES[array.dtype.str[1:]], at + pad)
        head += struct.pack(f"<{array.ndim}Q", *array.shape)
        data = array.tobytes()
        body, at = body + bytes(pad) + data, at + pad + len(data)
    assert len(head) == size
    return head + body


def facets(theta, alpha):
    """GGX's density of normals."""
    c2 = np.cos(theta) ** 2
    return alpha**2 / (np.pi * (c2 * (alpha**2 - 1) + 1) ** 2)


def area(theta, alpha):
    """Projected area of GGX's facets: cos / G1."""
    c = np.cos(theta)
    return 0.5 * (c + np.sqrt(alpha**2 + (1 - alpha**2) * c * c))


def bilinear(table, x, y):
    """A plain loop-free bilinear lookup in one square, nodes at both ends."""
    h, w = table.shape
    fx, fy = x * (w - 1), y * (h - 1)
    i, j = np.minimum(fy.astype(int), h - 2), np.minimum(fx.astype(int), w - 2)
    a, b = fy - i, fx - j
    return (1 - a) * ((1 - b) * table[i, j] + b * table[i, j + 1]) + a * (
        (1 - b) * table[i + 1, j] + b * table[i + 1, j + 1]
    )


def sample(density, n, n_fine=2001):
    """Where an n x n grid of cumulative probabilities (along x given y, along y) is reached.

    By fine trapezoids, knowing nothing of the closed forms.
    """
    fine = np.linspace(0, 1, n_fine)
    step = np.diff(fine)
    # a row's integral is linear between the nodes of y
    h, w = density.shape
    total = np.interp(fine, np.linspace(0, 1, h), np.trapezoid(density, dx=1 / (w - 1), axis=1))
    marginal = np.concatenate([[0], np.cumsum(0.5 * (total[1:] + total[:-1]) * step)])
    grid = np.linspace(0, 1, n)
    y = np.interp(grid, marginal / marginal[-1], fine)
    x = np.zeros((n, n))
    for line, at in zip(x, y, strict=True):
        row = bilinear(density, fine, np.full(n_fine, at))
        below = np.concatenate([[0], np.cumsum(0.5 * (row[1:] + row[:-1]) * step)])
        line[:] = np.interp(grid, below / below[-1], fine)
    return x, np.repeat(y[:, None], n, axis=1)


@cache
def ggx_fields(brdf, alpha, n_lights=9, n=32, n_normals=96, n_rows=24):
    """Tabulate an isotropic GGX surface of three channels as the EPFL's files hold one."""
    u = np.linspace(0, 1, n_normals)
    theta_m = u**2 * np.pi / 2
    theta_i = np.linspace(0, 1, n_lights) ** 0.7 * np.deg2rad(85)
    phi = (2 * np.linspace(0, 1, n_rows) - 1) * np.pi
    normals = np.stack(
        np.broadcast_arrays(
            np.sin(theta_m) * np.cos(phi[:, None]),
            np.sin(theta_m) * np.sin(phi[:, None]),
            np.cos(theta_m),
        ),
        axis=-1,
    )
    ndf = np.broadcast_to(facets(theta_m, alpha), (n_rows, n_normals))
    vndf = np.zeros((1, n_lights, n_rows, n_normals))
    rgb = np.zeros((1, n_lights, 3, n, n))
    for k, theta in enumerate(theta_i):
        wi = np.array([np.sin(theta), 0.0, np.cos(theta)])
        seen = np.maximum(normals @ wi, 0.0)
        vndf[0, k] = seen * ndf / area(theta, alpha) * 2 * np.pi**2 * u * np.sin(theta_m)
        # the table is read in float32, and so must be inverted
        x, y = sample(vndf[0, k].astype(np.float32).astype(np.float64), n)
        tm, pm = x**2 * np.pi / 2, (2 * y - 1) * np.pi
        m = np.stack([np.sin(tm) * np.cos(pm), np.sin(tm) * np.sin(pm), np.cos(tm)], axis=-1)
        wo = 2 * (m @ wi)[..., None] * m - wi
        value = brdf.eval_brdf(np.broadcast_to(wi, wo.shape), wo) * np.maximum(wo[..., 2:], 0.0)
        value *= 4 * area(theta, alpha) / bilinear(ndf, x, y)[..., None]
        rgb[0, k] = np.moveaxis(value, -1, 0)
    return {
        "description": np.frombuffer(b"a GGX surface", "u1"),
        "phi_i": np.zeros(1, "f4"),
        "theta_i": theta_i.astype("f4"),
        "sigma": np.broadcast_to(area(theta_m, alpha), (2, n_normals)).astype("f4"),
        "ndf": ndf.astype("f4"),
        "vndf": vndf.astype("f4"),
        "luminance": np.ones((1, n_lights, n, n), "f4"),
        "rgb": rgb.astype("f4"),
        "jacobian": np.ones(1, "u1"),
    }


def oriented_facets(m, alphas):
    """Anisotropic GGX's density of normals."""
    x, y, z = np.moveaxis(m, -1, 0)
    ax, ay = alphas
    return 1 / (np.pi * ax * ay * ((x / ax) ** 2 + (y / ay) ** 2 + z * z) ** 2)


def oriented_area(w, alphas):
    """Projected area of its facets."""
    x, y, z = np.moveaxis(w, -1, 0)
    ax, ay = alphas
    return 0.5 * (z + np.sqrt(z * z + (ax * x) ** 2 + (ay * y) ** 2))


def polar(theta, phi):
    """Unit vectors, theta and phi broadcast."""
    return np.stack(
        np.broadcast_arrays(
            np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
        ),
        axis=-1,
    )


@cache
def oriented_fields(
    brdf, alphas, reduction=4, n_azimuths=5, n_lights=6, n=20, n_normals=48, n_rows=49
):
    """Tabulate an anisotropic surface of three channels as the EPFL's files hold one.

    Any will do: the facets of an anisotropic GGX only say where its values lie close together.
    """
    u = np.linspace(0, 1, n_normals)
    theta_m, phi_m = u**2 * np.pi / 2, (2 * np.linspace(0, 1, n_rows)[:, None] - 1) * np.pi
    normals = polar(theta_m, phi_m)
    ndf = oriented_facets(normals, alphas)
    phi_i = -np.pi + np.linspace(0, 2 * np.pi / reduction, n_azimuths)
    theta_i = np.linspace(0, 1, n_lights) ** 0.7 * np.deg2rad(85)
    vndf = np.zeros((n_azimuths, n_lights, n_rows, n_normals))
    rgb = np.zeros((n_azimuths, n_lights, 3, n, n))
    for j, azimuth in enumerate(phi_i):
        for k, theta in enumerate(theta_i):
            wi = polar(theta, azimuth)
            area = oriented_area(wi, alphas)
            seen = np.maximum(normals @ wi, 0.0)
            vndf[j, k] = seen * ndf / area * 2 * np.pi**2 * u * np.sin(theta_m)
            # the table is read in float32, and so must be inverted
            x, y = sample(vndf[j, k].astype(np.float32).astype(np.float64), n, n_fine=1001)
            m = polar(x**2 * np.pi / 2, (2 * y - 1) * np.pi)
            wo = 2 * (m @ wi)[..., None] * m - wi
            value = brdf.eval_brdf(np.broadcast_to(wi, wo.shape), wo) * np.maximum(wo[..., 2:], 0)
            value *= 4 * area / bilinear(ndf, x, y)[..., None]
            rgb[j, k] = np.moveaxis(value, -1, 0)
    return {
        "description": np.frombuffer(b"a brushed surface", "u1"),
        "phi_i": phi_i.astype("f4"),
        "theta_i": theta_i.astype("f4"),
        "sigma": oriented_area(normals, alphas).astype("f4"),
        "ndf": ndf.astype("f4"),
        "vndf": vndf.astype("f4"),
        "luminance": np.ones((n_azimuths, n_lights, n, n), "f4"),
        "rgb": rgb.astype("f4"),
        "jacobian": np.ones(1, "u1"),
    }
