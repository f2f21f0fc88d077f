"""What rounding the factors of a part adds to its squared radiance error: measured, and foreseen.

The transfer of a vertex is T_x = U_view M_c(w_x), where M_c holds the dual basis of its cluster
with the light basis folded in, or its mean (of weight 1) and components.  Rounding changes it by

    T'_x - T_x = U_view [ M_c(w'_x - w_x) + (M'_c - M_c)(w'_x) ],

a quadratic form of as many dimensions as twice the weights, so the error of a cluster takes two
small Gram matrices and no vertex' transfer.  The view texture phi' turns view columns into
radiance; its own rounding adds the integral of cos^2 |dphi' . M_c(w_x)|^2 over the hemisphere.

A number rounded with step s is off by s^2 / 12 in the mean square, and the squared error grows by
that times what the number weighs: bases being orthonormal, the area of its vertex for a weight, the
energy that its column carries for a basis (`number_weights`).  The sum over all numbers foresees
the error as long as no column falls below its step.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from prtbake_storage.decode.asset import Part
from prtbake_storage.decode.quantise import Scales, rounded_factors
from prtbake_storage.decode.view_map import hemi_octahedral_inverse, texel_centres
from prtbake_workers.arrays import F64, I32, Float64
from prtbake_workers.compress.clusters import members_by_cluster
from prtbake_workers.compress.parallel import same_bytes_on_any_threads

HEMISPHERE = 2.0 * np.pi / 3.0
"""Integral of cos^2 over it."""


class RoundingError(NamedTuple):
    """Squared radiance error, weighted by area: of the coefficients, and of the view texture."""

    factors: float
    texture: float

    @property
    def total(self) -> float:
        """Both: they are independent, so squares add up."""
        return self.factors + self.texture


def rounding_error(exact: Part, rounded: Part, areas: Float64[F64, " verts"]) -> RoundingError:
    """Measure by how much two parts of the same clusters differ.

    ``areas`` weigh the vertices.  That of the texture is taken at the texels; lookups between them
    are off by less.
    """
    columns = np.linalg.qr(exact.view_basis.astype(np.float64), mode="r")
    factors, power = 0.0, np.zeros(())
    with same_bytes_on_any_threads():
        for cluster, members in enumerate(members_by_cluster(exact.labels, exact.n_clusters)):
            before, after = folded_rows(exact, cluster), folded_rows(rounded, cluster)
            given, found = vertex_weights(exact, members), vertex_weights(rounded, members)
            joint = np.concatenate([found - given, found], axis=1)
            moments = joint.T @ (joint * areas[members, None])
            # (2 R, channels, view, coeffs); the view basis is orthonormal but for its own rounding
            rows = columns @ np.concatenate([before, after - before])
            flat = rows.reshape(len(rows), -1)
            factors += max(0.0, float(np.sum(moments * (flat @ flat.T))))
            if exact.view_texture is not None:
                weighed = given.T @ (given * areas[members, None])
                power = power + column_power(before, weighed)
        texture = _texture_error(exact, rounded, power)
    return RoundingError(factors, texture)


def folded_rows(part: Part, cluster: int) -> Float64[F64, "ranks channels r_view coeffs"]:
    """Return M_c, a row a weight: light bases folded into dual ones, or mean and components."""
    if part.light_bases is not None and part.dual_bases is not None:
        light = part.light_bases[cluster].astype(np.float64)
        shape = (-1, part.n_channels, part.n_view, light.shape[1])
        dual = part.dual_bases[cluster].astype(np.float64).reshape(shape)
        return np.asarray(dual @ light.T)
    if part.means is None or part.components is None:
        raise ValueError(f"part {part.name!r} holds no factors")
    rows = np.concatenate([part.means[cluster][None], part.components[cluster]])
    return rows.astype(np.float64).reshape(len(rows), part.n_channels, part.n_view, -1)


def vertex_weights(part: Part, members: I32) -> Float64[F64, "members ranks"]:
    """Return the weights of `folded_rows` at some vertices; that of a mean is 1."""
    weights = part.weights[members].astype(np.float64)
    if part.means is None:
        return weights
    return np.concatenate([np.ones((len(weights), 1)), weights], axis=1)


def column_power(
    rows: Float64[F64, "ranks channels r_view coeffs"], moments: Float64[F64, "ranks ranks"]
) -> Float64[F64, "channels r_view r_view"]:
    """Return the area-weighted inner products over coefficients of the view columns."""
    mixed = np.tensordot(moments, rows, axes=1)
    products = rows.transpose(1, 0, 2, 3) @ mixed.transpose(1, 0, 3, 2)
    return np.asarray(products.sum(axis=1))


def _texture_error(exact: Part, rounded: Part, power: F64) -> float:
    """Integrate cos^2 |dphi' . M(w)|^2 by the texels; power is that of `column_power`."""
    if exact.view_texture is None or rounded.view_texture is None:
        return 0.0
    off = rounded.view_texture.astype(np.float64) - exact.view_texture
    colours = off.shape[-1]
    # channel c of the texture meets channel c of the transfer where both have several
    own = power if len(power) == colours else np.repeat(power.sum(axis=0)[None], colours, axis=0)
    off *= np.sqrt(cosine_weights(len(off)))[:, :, None, None]
    error = 0.0
    for channel in range(colours):
        columns = off[..., channel].reshape(-1, off.shape[2])
        error += float(np.sum((columns.T @ columns) * own[channel]))
    return max(0.0, error)


def cosine_weights(resolution: int) -> Float64[F64, "rows columns"]:
    """Return cos^2 times the solid angle of the texels of a view texture.

    Scaled to the sum 2 pi / 3.  A texel of the flat map spans 2 du dv / |p|^3 steradians, with p
    = (x, y, 1 - |x| - |y|) its point on the octahedron: the foot of the direction's unit vector.
    """
    directions = hemi_octahedral_inverse(texel_centres(resolution)).astype(np.float64)
    # |p| = 1 / (|d_x| + |d_y| + d_z)
    weights = directions[..., 2] ** 2 * np.abs(directions).sum(axis=-1) ** 3
    return np.asarray(weights * (HEMISPHERE / weights.sum()))


def number_weights(part: Part, areas: Float64[F64, " verts"]) -> dict[str, F64]:
    """Return how much squared error a number adds per unit of its own; shapes as in `Scales`.

    Of a weight it is the mean over the cluster's vertices, which share the step.  Zero where
    nothing depends on a column.
    """
    with same_bytes_on_any_threads():
        clusters = [
            _cluster_weights(part, cluster, members, areas[members])
            for cluster, members in enumerate(members_by_cluster(part.labels, part.n_clusters))
        ]
    found = {name: [own[name] for own in clusters] for name in clusters[0]}
    texture = found.pop("view_texture", None)
    weights = {name: np.stack(values) for name, values in found.items()}
    if texture is not None and part.view_texture is not None:
        power = np.sum(texture, axis=0)  # (channels, r_view)
        colours, resolution = part.view_texture.shape[-1], len(part.view_texture)
        own = power if len(power) == colours else np.repeat(power.sum(axis=0)[None], colours, 0)
        weights["view_texture"] = own.T[None, None] * (HEMISPHERE / resolution**2)
    return weights


def _cluster_weights(part: Part, cluster: int, members: I32, areas: F64) -> dict[str, F64]:
    """Return a cluster's share of `number_weights`; of the texture the columns' energies."""
    rows, given = folded_rows(part, cluster), vertex_weights(part, members)
    moments = given.T @ (given * areas[:, None])
    area = float(areas.sum())
    lengths = np.einsum("rcvl,rcvl->r", rows, rows)
    found = {
        "weights": area / max(1, len(members)) * lengths[len(lengths) - part.weights.shape[1] :]
    }
    if part.light_bases is not None and part.dual_bases is not None:
        dual = part.dual_bases[cluster].astype(np.float64)
        carried = dual * (moments @ dual)
        columns = carried.reshape(-1, part.light_bases.shape[2])
        found["light_bases"] = columns.sum(axis=0)[None]
        found["dual_bases"] = np.diag(moments)[:, None]
    else:
        found["means"] = np.array([area])
        found["components"] = np.diag(moments)[1:, None]
    if part.view_texture is not None:
        found["view_texture"] = np.einsum("cvv->cv", column_power(rows, moments))
    return found


def foreseen_error(part: Part, scales: Scales, weights: Mapping[str, F64]) -> float:
    """Return the sum over all numbers of what they weigh, times step^2 / 12.

    Holds where a step is small beside the spread of its column, within a few per cent.
    """
    return sum(
        float(np.sum(count * weights[name] * scales[name].astype(np.float64) ** 2)) / 12.0
        for name, count in number_counts(part)
    )


def number_counts(part: Part) -> Iterator[tuple[str, F64]]:
    """Name and numbers under each scale, broadcast to shapes as in `Scales`."""
    for name, array in rounded_factors(part):
        if name == "weights":
            members = np.bincount(part.labels, minlength=part.n_clusters)
            yield name, members.astype(np.float64)[:, None]
        elif name == "view_texture":
            yield name, np.full((1, 1, 1, 1), float(array.shape[0] * array.shape[1]))
        else:
            shared = array.shape[1] if name in ("light_bases", "means") else array.shape[2]
            yield name, np.full((1,) * array.ndim, float(shared))
