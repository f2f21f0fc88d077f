"""What a compressed asset is, as plain numpy arrays.

An asset is one mesh cut into parts.  Every part has a material and the factors of its compressed
transfer tensor T (terms x coeffs x verts), whose light axis is that of an orthonormal basis
(docs/theory, "The metric"): a vertex x of cluster c has

    tensor factors  T_x = U_view  uf^-1(V_c^T w_x)  U_light,c^T          [Tsai2006]_ eq. (18)
    means           T_x = U_view  (mean_c + sum_p w_xp component_cp)     [Sloan2003]_ section 4

Clustered tensor approximation (CTA) makes the former; PCA, clustered PCA and, with no components,
vector quantisation the latter, where U_view is the identity.  Decoders ask which factors there are,
never which method made them.

Light that coloured surfaces pass on to each other gives each colour a transfer of its own.  A part
then has three channels of it, (3 * terms x coeffs x verts), channel by channel: row c * terms + k.
Channel c of the light meets channel c of the transfer.  Both formulas hold with the channels' rows
under each other: they share labels, weights, U_view and U_light,c, and V_c and the mean and
components are as many times longer.

Cluster arrays are zero padded to the largest rank of the part, so they are plain arrays.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.overdraw import average_overdraw
from prtbake_storage.decode.sides import opposite_faces
from prtbake_storage.decode.superclusters import Superclusters, check_superclusters
from prtbake_storage.decode.transfer_basis import TransferBasis

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]

Method = Literal["vq", "pca", "cpca", "cta"]

FACTORS: Mapping[Method, tuple[str, ...]] = {
    "vq": ("means",),
    "pca": ("means", "components", "weights"),
    "cpca": ("means", "components", "weights"),
    "cta": ("light_bases", "dual_bases", "weights"),
}
"""Method -> what it makes beside labels, ranks and the view basis.

Components and weights of ``vq`` are arrays of no numbers, which no file holds."""

Role = Literal["object", "receiver"]
"""What a part is in its scene: all or some of the object, or what that stands on."""

CHANNEL_COUNTS = (1, 3)
"""Transfer is the same for all colours, or differs in red, green and blue."""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A run of vertices with one material.

    Parameters
    ----------
    name
        ``object``, ``receiver``, or the groups of faces that the part is made of.
    vertex_range
        First vertex and one past the last, in the mesh's numbering.
    material
        The BRDF as JSON.
    albedo
        (1,) or (3,) multiplies every colour of the part.
    albedo_texture
        (height, width, 3) linear Rec.709, row 0 at v = 1, repeated outside [0, 1]; or None.
    vertex_colours
        (verts, 3) linear Rec.709 in [0, 1], interpolated over the triangles; or None.  All three
        multiply.
    factorisation
        The BRDF's separable tables, for whoever wants to evaluate phi without the texture.
    n_channels
        1, or 3 where transfer differs by the colour of the light.
    role
        The object may have several parts: they shadow each other as one shape.
    two_sided
        Whether every vertex and triangle is there twice, once for each side, as
        `prtbake_storage.decode.sides` describes.  Of a part with one side the back is black.
    """

    name: str
    vertex_range: tuple[int, int]
    material: Mapping[str, Any]
    albedo: F32
    albedo_texture: F32 | None = None
    vertex_colours: F32 | None = None
    factorisation: Mapping[str, Any] | None = None
    n_channels: int = 1
    role: Role = "object"
    two_sided: bool = False

    @property
    def n_vertices(self) -> int:
        """Vertices of the part."""
        return self.vertex_range[1] - self.vertex_range[0]


@dataclass(frozen=True, kw_only=True)
class Precision:
    """How exactly the rounded factors of a part are held.

    ``bits`` names each with those that its largest number takes, sign included; ``error`` is the
    squared-error ratio in radiance norm that rounding adds, None where the file does not say.
    """

    bits: Mapping[str, int]
    error: float | None = None


@dataclass(frozen=True, kw_only=True)
class Part(Surface):
    """A surface with one set of factors.

    Parameters
    ----------
    method
        How the factors were made; `FACTORS` says which they are.
    labels
        (verts,) cluster of each vertex of the part.
    weights
        (verts, R) projected weights w_x, zero beyond the cluster's own rank; R is 0 for ``vq``.
    view_basis
        (terms, R_view) orthonormal columns; with means the identity.
    view_texture
        (res, res, R_view, channels) pre-filtered phi' = phi U_view on the hemi-octahedral map of
        ``view_map``; None where phi is the constant 1.
    light_bases
        (clusters, coeffs, R_light) U_light,c.
    dual_bases
        (clusters, R_vert, channels * R_view * R_light) V_c, with the channels of the transfer; a
        row unfolds to (channels, R_view, R_light), light last.
    means, components
        (clusters, D) and (clusters, R, D) with D = channels * R_view * coeffs, unfolded from
        (channels, R_view, coeffs), coeffs last.
    frames
        (verts, 3, 3) rows tangent, bitangent, normal; needed with a view texture.
    ranks
        (clusters, 3) true (view, light, vert) ranks; with means (terms, coeffs, components used).
    precision
        Bits of the factors and the error of rounding them; None where they were not rounded.
    superclusters
        Index buffers for renderers that hold a few clusters at a time, where they were asked for.
    """

    method: Method
    labels: I32
    weights: F32
    ranks: I32
    view_basis: F32 = field(default_factory=lambda: np.ones((1, 1), np.float32))
    view_texture: F32 | None = None
    light_bases: F32 | None = None
    dual_bases: F32 | None = None
    means: F32 | None = None
    components: F32 | None = None
    frames: F32 | None = None
    precision: Precision | None = None
    superclusters: Superclusters | None = None

    @property
    def n_clusters(self) -> int:
        """Clusters of the part."""
        return int(self.ranks.shape[0])

    @property
    def n_view(self) -> int:
        """R_view."""
        return int(self.view_basis.shape[1])

    def factors(self) -> Iterator[tuple[str, NDArray[Any]]]:
        """Name and array of everything that the compression made."""
        for name in ("labels", "weights", "view_basis", "light_bases", "dual_bases", "means",
                     "components"):  # fmt: skip
            array = getattr(self, name)
            if array is not None:
                yield name, array

    @property
    def nbytes(self) -> dict[str, int]:
        """Bytes in memory: ``factors``, and each array of the surface by its name."""
        sizes = {"factors": sum(array.nbytes for _, array in self.factors())}
        for name in ("view_texture", "frames", "albedo_texture", "vertex_colours"):
            array = getattr(self, name)
            sizes[name] = 0 if array is None else int(array.nbytes)
        if self.superclusters is not None:
            sizes["superclusters"] = self.superclusters.nbytes
        return sizes


@dataclass(frozen=True, kw_only=True)
class Asset:
    """A mesh with compressed transfer, ready to be relit.

    ``basis`` holds the orthonormal functions of incident light that the light axis lives in.
    Positions are in scene units, normals of unit length.
    """

    positions: F32
    faces: I32
    normals: F32
    uv: F32 | None
    parts: tuple[Part, ...]
    basis: TransferBasis
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def n_vertices(self) -> int:
        """Vertices of all parts."""
        return int(self.positions.shape[0])

    @property
    def n_coeffs(self) -> int:
        """Functions of the basis."""
        return self.basis.n_coeffs

    @property
    def object_ranges(self) -> list[tuple[int, int]]:
        """Vertex ranges of the object's parts; of all parts where none is the object's."""
        own = [part.vertex_range for part in self.parts if part.role == "object"]
        return own or [part.vertex_range for part in self.parts]

    @property
    def part_of_vertex(self) -> I32:
        """(verts,) index of the part each vertex belongs to."""
        owner = np.full(self.n_vertices, -1, np.int32)
        for index, part in enumerate(self.parts):
            owner[slice(*part.vertex_range)] = index
        return owner

    def faces_of(self, index: int) -> I32:
        """(tris, 3) corners of a part's triangles, in the part's own numbering of vertices."""
        start, stop = self.parts[index].vertex_range
        first = self.faces[:, 0]
        return self.faces[(first >= start) & (first < stop)] - np.int32(start)

    def overdraw_of(self, index: int) -> float:
        """Triangles of a part that are drawn a cluster at a time, over its triangles: 1 to 3."""
        return average_overdraw(self.faces_of(index), self.parts[index].labels)

    @property
    def overdraw(self) -> float:
        """`overdraw_of` all parts together: triangles drawn over triangles, 1 without any."""
        triangles = [len(self.faces_of(index)) for index in range(len(self.parts))]
        drawn = sum(self.overdraw_of(index) * count for index, count in enumerate(triangles))
        return drawn / sum(triangles) if any(triangles) else 1.0

    @cached_property
    def opposite(self) -> I64 | None:
        """(tris,) copy of each triangle on its other side, -1 for none; None where all are."""
        sides = [part.two_sided for part in self.parts]
        if not any(sides):
            return None
        return opposite_faces(self.faces, [part.vertex_range for part in self.parts], sides)

    @property
    def nbytes(self) -> dict[str, int]:
        """Bytes in memory by group: ``mesh`` and the sums of the parts' groups."""
        uv = 0 if self.uv is None else int(self.uv.nbytes)
        mesh = self.positions.nbytes + self.faces.nbytes + self.normals.nbytes
        sizes = {"mesh": int(mesh) + uv}
        for part in self.parts:
            for name, value in part.nbytes.items():
                sizes[name] = sizes.get(name, 0) + value
        return sizes


def check_asset(asset: Asset) -> None:
    """Hold an asset against its own rules.

    Raises
    ------
    ValueError
        Naming the first array with a wrong shape, index or number.
    """
    verts = asset.n_vertices
    _shape("mesh/positions", asset.positions, (verts, 3))
    _shape("mesh/normals", asset.normals, (verts, 3))
    _shape("mesh/faces", asset.faces, (len(asset.faces), 3))
    _indices("mesh/faces", asset.faces, verts)
    if asset.uv is not None:
        _shape("mesh/uv", asset.uv, (verts, 2))
    asset.basis.check()
    stop = 0
    for index, part in enumerate(asset.parts):
        if part.vertex_range[0] != stop or part.vertex_range[1] <= stop:
            raise ValueError(
                f"parts/{index}/vertex_range {part.vertex_range} does not follow {stop}"
            )
        stop = part.vertex_range[1]
        _check_part(f"parts/{index}", part, asset.n_coeffs)
        if part.albedo_texture is not None and asset.uv is None:
            raise ValueError(f"parts/{index}/albedo_texture needs mesh/uv")
    if stop != verts:
        raise ValueError(f"parts cover {stop} of {verts} vertices")
    owner = asset.part_of_vertex[asset.faces]
    torn = np.flatnonzero((owner != owner[:, :1]).any(axis=1))
    if torn.size:
        raise ValueError(f"mesh/faces: triangle {torn[0]} joins two parts")
    for index, part in enumerate(asset.parts):
        if part.superclusters is not None:
            check_superclusters(
                f"parts/{index}/superclusters",
                part.superclusters,
                asset.faces_of(index),
                part.labels,
                part.n_clusters,
                part.vertex_range[0],
            )
    _ = asset.opposite


def _check_part(where: str, part: Part, n_coeffs: int) -> None:
    verts, clusters, n_view = part.n_vertices, part.n_clusters, part.n_view
    if part.n_channels not in CHANNEL_COUNTS:
        raise ValueError(f"{where}/n_channels is {part.n_channels}, not 1 or 3")
    _shape(f"{where}/clusters/ranks", part.ranks, (clusters, 3))
    _shape(f"{where}/clusters/labels", part.labels, (verts,))
    _indices(f"{where}/clusters/labels", part.labels, clusters)
    lacking = [name for name in FACTORS[part.method] if getattr(part, name) is None]
    if lacking:
        raise ValueError(f"{where}: {part.method} needs {' and '.join(lacking)}")
    if (part.means is None) == (part.light_bases is None):
        raise ValueError(f"{where}: means and light_bases exclude each other")
    n_weights = part.weights.shape[-1]
    if "weights" in FACTORS[part.method]:
        _shape(f"{where}/weights", part.weights, (verts, n_weights))
    elif n_weights:
        raise ValueError(f"{where}/weights: {part.method} has none, not {n_weights} a vertex")
    _shape(f"{where}/view_basis", part.view_basis, (part.view_basis.shape[0], n_view))
    if part.light_bases is not None and part.dual_bases is not None:
        n_light = part.light_bases.shape[-1]
        _shape(f"{where}/clusters/light_bases", part.light_bases, (clusters, n_coeffs, n_light))
        dual_shape = (clusters, n_weights, part.n_channels * n_view * n_light)
        _shape(f"{where}/clusters/dual_bases", part.dual_bases, dual_shape)
    if part.means is not None:
        dims = part.n_channels * n_view * n_coeffs
        _shape(f"{where}/clusters/means", part.means, (clusters, dims))
        if part.components is None or part.components.shape != (clusters, n_weights, dims):
            found = None if part.components is None else part.components.shape
            raise ValueError(
                f"{where}/clusters/components has shape {found}, not {(clusters, n_weights, dims)}"
            )
        _finite(f"{where}/clusters/components", part.components)
    _check_ranks(f"{where}/clusters/ranks", part, n_coeffs)
    if part.view_texture is not None:
        res, channels = part.view_texture.shape[0], part.view_texture.shape[-1]
        _shape(f"{where}/view_texture", part.view_texture, (res, res, n_view, channels))
        if channels not in (1, 3):
            raise ValueError(f"{where}/view_texture has {channels} channels, not 1 or 3")
        if part.frames is None:
            raise ValueError(f"{where}/frames: a view texture needs them")
    elif n_view != 1:
        raise ValueError(f"{where}/view_texture: {n_view} view columns need one")
    if part.frames is not None:
        _shape(f"{where}/frames", part.frames, (verts, 3, 3))
    if part.albedo.shape not in {(1,), (3,)}:
        raise ValueError(f"{where}/albedo has shape {part.albedo.shape}, not (1,) or (3,)")
    _finite(f"{where}/albedo", part.albedo)
    if part.albedo_texture is not None:
        _shape(f"{where}/albedo_texture", part.albedo_texture,
               (*part.albedo_texture.shape[:2], 3))  # fmt: skip
    if part.vertex_colours is not None:
        _shape(f"{where}/vertex_colours", part.vertex_colours, (verts, 3))
        _fractions(f"{where}/vertex_colours", part.vertex_colours)


def _check_ranks(name: str, part: Part, n_coeffs: int) -> None:
    """Hold the ranks against the arrays that they are ranks of."""
    of_light = n_coeffs if part.light_bases is None else part.light_bases.shape[-1]
    most = np.array([part.n_view, of_light, part.weights.shape[-1]])
    bad = np.argwhere((part.ranks < 0) | (part.ranks > most))
    if bad.size:
        place = tuple(int(i) for i in bad[0])
        raise ValueError(f"{name} is {part.ranks[place]} at {place}, outside 0 to {most[place[1]]}")


def _shape(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, not {shape}")
    if 0 in shape:
        raise ValueError(f"{name} is empty: shape {shape}")
    _finite(name, array)


def _finite(name: str, array: NDArray[Any]) -> None:
    if array.dtype.kind != "i" and array.dtype != np.float32:
        raise ValueError(f"{name} is {array.dtype}, not float32")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name} is not finite at {place}")


def _fractions(name: str, array: NDArray[Any]) -> None:
    bad = np.argwhere((array < 0.0) | (array > 1.0))
    if bad.size:
        place = tuple(int(i) for i in bad[0])
        raise ValueError(f"{name} is {array[place]} at {place}, outside [0, 1]")


def _indices(name: str, array: NDArray[Any], stop: int) -> None:
    bad = np.argwhere((array < 0) | (array >= stop))
    if bad.size:
        place = tuple(int(i) for i in bad[0])
        raise ValueError(f"{name} is {array[place]} at {place}, outside [0, {stop})")
