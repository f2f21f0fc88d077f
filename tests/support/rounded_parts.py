"""Parts with orthonormal bases and columns of falling energy, as compression leaves them."""

from dataclasses import replace

import numpy as np

from prtbake_storage.decode.asset import Part

CLUSTERS, COEFFS, TERMS = 3, 40, 6
R_VIEW, R_LIGHT, R_VERT, PCS = 3, 8, 6, 5


def orthonormal(rng: np.random.Generator, n: int, columns: int) -> np.ndarray:
    return np.linalg.qr(rng.normal(size=(n, columns)))[0].astype(np.float32)


def make_part(
    rng: np.random.Generator, method: str, *, n_verts: int = 700, n_channels: int = 1
) -> Part:
    """A part of either method; CTA with a view texture of 12 x 12 texels in three colours."""
    labels = rng.integers(0, CLUSTERS, n_verts).astype(np.int32)
    common = {
        "name": "object", "vertex_range": (0, n_verts), "material": {}, "labels": labels,
        "albedo": np.ones(1, np.float32), "n_channels": n_channels,
        "ranks": np.ones((CLUSTERS, 3), np.int32),
    }  # fmt: skip
    n_weights = R_VERT if method == "cta" else PCS
    falling = 0.4 ** np.arange(n_weights)
    weights = (rng.normal(size=(n_verts, n_weights)) * falling).astype(np.float32)
    if method == "cpca":
        dims = n_channels * COEFFS
        components = [orthonormal(rng, dims, PCS).T for _ in range(CLUSTERS)]
        return Part(
            method="cpca", weights=weights, components=np.stack(components),
            means=rng.normal(size=(CLUSTERS, dims)).astype(np.float32) * np.float32(0.3), **common,
        )  # fmt: skip
    # energies of light columns differ too
    tilt = np.tile(0.6 ** np.arange(R_LIGHT), n_channels * R_VIEW)
    dual = [
        np.linalg.qr(rng.normal(size=(len(tilt), R_VERT)) * tilt[:, None])[0].T
        for _ in range(CLUSTERS)
    ]
    light = [orthonormal(rng, COEFFS, R_LIGHT) for _ in range(CLUSTERS)]
    return Part(
        method="cta", weights=weights, view_basis=orthonormal(rng, TERMS, R_VIEW),
        light_bases=np.stack(light), dual_bases=np.stack(dual).astype(np.float32),
        view_texture=rng.normal(size=(12, 12, R_VIEW, 3)).astype(np.float32),
        frames=np.tile(np.eye(3, dtype=np.float32), (n_verts, 1, 1)), **common,
    )  # fmt: skip


def dense(part: Part) -> np.ndarray:
    """Transfer (verts, channels, view terms, coeffs) in float64, one vertex after the other."""
    out = []
    for label, weights in zip(part.labels, part.weights.astype(np.float64), strict=True):
        if part.method == "cpca":
            row = part.means[label] + weights @ part.components[label].astype(np.float64)
            out.append(row.reshape(part.n_channels, 1, -1))
            continue
        core = weights @ part.dual_bases[label].astype(np.float64)
        core = core.reshape(part.n_channels, part.n_view, -1)
        light = part.light_bases[label].astype(np.float64)
        out.append(np.stack([part.view_basis.astype(np.float64) @ c @ light.T for c in core]))
    return np.stack(out)


def with_factor(part: Part, name: str, values: np.ndarray) -> Part:
    return replace(part, **{name: values.astype(np.float32)})
