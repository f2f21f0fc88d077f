"""Predict the bytes of a job's files: what is known is packed, what will come is counted.

Mesh, frames, tables of BRDFs and textures are there before the first ray: they are packed as the
file will.  Coefficients are noise in their low bits: they pack to much the same share of themselves
whatever the scene.  What factors take follows from what compression leaves: `trial_compression`
tries it; where it does not, they are taken to have what they have in the mean.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil, log
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import CompressSettings
from prtbake_workers.arrays import F64, I32
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.view_texture import (
    ERROR_TOLERANCE,
    LARGEST,
    SMALLEST,
    lookup_error,
    view_texture,
)
from prtbake_workers.planning.packed_bytes import packed_bytes

FILE_BYTES, ARRAY_BYTES = 4000, 310
"""Of HDF5 itself: of a file and of each array in it."""

PROVENANCE_BYTES = 1500

CENTRE_BYTES, LABEL_BYTES = 13.1, 0.2
"""Of an SRBF's centre, three float64 of an icosphere, and of a vertex' label."""

SURE_SHARE = 0.9
"""Of the packed mesh, that the file is sure to take: of a large one some chunks are packed."""

MANY_TERMS_SHARE, SHADOWED_SHARE, EVEN_SHARE = 0.85, 0.83, 0.74
"""Of 2 bytes a coefficient: of more terms than one, of one whose light the part itself or another
blocks, and of one on a plane or in the open, which is smoother."""

CHANNELS_SHARE = 0.78
"""Of that where there are three channels: much of what they hold is the same, but where light that
is scattered inside has a way of its own in each."""

SCALE_SHARE, ENERGY_SHARE = 0.28, 0.68
"""Of the 4 bytes of a row's scale, and of the 16 of a vertex's two energies."""

Bits = Literal[8, 16, 32, "auto"]

FACTOR_BYTES: dict[Bits, float] = {32: 3.48, 16: 1.9, 8: 0.82, "auto": 0.88}
EVEN_FACTOR_BYTES = 0.53
TEXTURE_BYTES: dict[Bits, float] = {32: 3.12, 16: 1.8, 8: 0.75, "auto": 0.55}
"""Of a number of factors and of view textures, by the bits that it is asked to have; of factors of
even parts of one term, which no light scattered inside makes uneven, in bits that their error
chooses, which is larger."""

PART_ARRAYS, TRANSFER_ARRAYS, ASSET_ARRAYS, TEXTURE_ARRAYS = 10, 6, 9, 5
"""Of a part in either file, in transfer and in the asset beside, and where that has a view texture;
the mesh and the basis are 5."""

AVERAGED = 1.46
"""Error of a texture that averages its texels over one that samples them: 1.45 to 1.48 measured."""

FINER = 3.5
"""By which twice the resolution divides the error of a view texture."""


@dataclass(frozen=True)
class NumberBytes:
    """Bytes of a number of a part's factors, scales included, and of its view texture."""

    factors: float
    texture: float


@dataclass(frozen=True)
class KnownBytes:
    """Packed bytes of what is known of a scene, in both files.

    Attributes
    ----------
    transfer
        Of the transfer file: mesh and parts in 64 bits.
    asset
        Of assets: 32 of exact ones, 16 of all others, which hold directions in so many bits.
    texels
        Of each part's view texture, 0 where it has none.
    """

    transfer: int
    asset: Mapping[int, int]
    texels: tuple[int, ...]


@dataclass(frozen=True)
class PartNumbers:
    """What is counted of one part: vertices, rows (channels x terms), coefficients and factors.

    ``view_columns`` are those of the view texture, of all channels; ``even`` parts are planes, or
    lie in the open; ``scattered`` ones have a medium that moves light inside them; ``tried`` is
    what a trial found that their numbers take, where there was one and error chooses the bits.
    """

    n_verts: int
    n_rows: int
    n_channels: int
    even: bool
    n_coeffs: int
    factor_floats: int
    view_columns: int
    scattered: bool = False
    tried: NumberBytes | None = None

    @property
    def single(self) -> bool:
        """Whether a channel has one term."""
        return self.n_rows == self.n_channels


def known_bytes(
    mesh: Sequence[NDArray[Any]],
    faces: I32,
    parts: Sequence[Sequence[NDArray[Any]]],
    factorisations: Sequence[Factorisation],
    frames: Sequence[F64],
    *,
    n_centres: int = 0,
) -> KnownBytes:
    """Pack what is known.

    Parameters
    ----------
    mesh
        Positions, normals and, where there are any, texture coordinates.
    parts
        Of each, the arrays that all files hold as they are: texture, colours.
    factorisations, frames
        Of each part; frames are stored where a BRDF turns with them.
    n_centres
        SRBFs of the basis: other functions need no array.
    """
    shared = packed_bytes(faces) + PROVENANCE_BYTES + round(CENTRE_BYTES * n_centres)
    transfer, asset = shared, {16: shared, 32: shared}
    for place, array in enumerate(mesh):
        single = packed_bytes(array.astype(np.float32))
        transfer += packed_bytes(array.astype(np.float64))
        asset[32] += single
        # normals are unit vectors in 16 bits
        asset[16] += packed_bytes(_units(array)) if place == 1 else single
    for own, factorisation, turned in zip(parts, factorisations, frames, strict=True):
        tables = [one for one in factorisation.tables().values() if isinstance(one, np.ndarray)]
        same = sum(packed_bytes(np.atleast_1d(one)) for one in (*tables, *own))
        transfer += same
        asset = {bits: count + same for bits, count in asset.items()}
        if not factorisation.is_constant_phi:
            transfer += packed_bytes(turned)
            asset[32] += packed_bytes(turned.astype(np.float32))
            asset[16] += packed_bytes(_units(turned[:, 0]))
    texels = tuple(0 if one.is_constant_phi else texture_side(one) ** 2 for one in factorisations)
    return KnownBytes(transfer, asset, texels)


def least_bytes(mesh: Sequence[NDArray[Any]], faces: I32) -> int:
    """Give bytes that no ``asset.h5`` of a mesh is smaller than; ``mesh`` as in `known_bytes`."""
    return round(SURE_SHARE * (known_bytes(mesh, faces, (), (), ()).asset[16] - PROVENANCE_BYTES))


def term_bytes(factorisation: Factorisation) -> float:
    """Give the packed bytes of tables that a term takes: all but the values, listed whole."""
    tables = [
        packed_bytes(np.atleast_1d(one))
        for name, one in factorisation.tables().items()
        if isinstance(one, np.ndarray) and name != "singular_values"
    ]
    return sum(tables) / factorisation.n_terms


def texture_side(factorisation: Factorisation) -> int:
    """Foresee the resolution that `fit_view_texture` comes to, from the error of the coarsest."""
    sampled = view_texture(factorisation, SMALLEST, supersample=1)
    error = AVERAGED * lookup_error(factorisation, sampled)
    if error <= ERROR_TOLERANCE:
        return SMALLEST
    doublings = ceil(log(error / ERROR_TOLERANCE) / log(FINER))
    return int(min(LARGEST, SMALLEST << doublings))


def transfer_bytes(known: KnownBytes, parts: Sequence[PartNumbers]) -> int:
    """Predict ``transfer.h5``."""
    found = float(known.transfer + _frame(len(parts), TRANSFER_ARRAYS))
    for part in parts:
        rows = part.n_verts * part.n_rows
        found += _coefficient_share(part) * 2 * rows * part.n_coeffs
        found += SCALE_SHARE * 4 * rows + ENERGY_SHARE * 16 * part.n_verts
    return round(found)


def _coefficient_share(part: PartNumbers) -> float:
    share = EVEN_SHARE if part.even else SHADOWED_SHARE
    if part.scattered:
        return SHADOWED_SHARE
    if not part.single:
        share = MANY_TERMS_SHARE
    return share if part.n_channels == 1 else CHANNELS_SHARE * share


def asset_bytes(known: KnownBytes, parts: Sequence[PartNumbers], *, bits: Bits) -> int:
    """Predict ``asset.h5``, or ``asset-float32.h5`` (32 bits)."""
    found = float(known.asset[32 if bits == 32 else 16] + _frame(len(parts), ASSET_ARRAYS))
    for part, texels in zip(parts, known.texels, strict=True):
        found += LABEL_BYTES * part.n_verts + (ARRAY_BYTES * TEXTURE_ARRAYS if texels else 0)
        each = number_bytes(part, bits)
        found += each.factors * part.factor_floats + each.texture * texels * part.view_columns
    return round(found)


def number_bytes(part: PartNumbers, bits: Bits) -> NumberBytes:
    """Predict the bytes of a number of a part: by its trial, or by what parts have in the mean."""
    if bits == "auto" and part.tried is not None:
        return part.tried
    even = part.even and part.single and not part.scattered and bits == "auto"
    factors = EVEN_FACTOR_BYTES if even else FACTOR_BYTES[bits]
    return NumberBytes(factors, TEXTURE_BYTES[bits])


def asked_asset_bytes(
    known: KnownBytes, parts: Sequence[PartNumbers], settings: CompressSettings
) -> int:
    """Predict ``asset.h5``, which fills a number of bytes where no error is asked for.

    It holds no more numbers than the transfer then.
    """
    found = asset_bytes(known, parts, bits=settings.bits)
    if settings.max_bytes is None:
        return found
    if settings.max_error is None:
        found = transfer_bytes(known, parts)
    return min(found, settings.max_bytes)


def light_bytes(settings: FitLightSettings) -> int:
    """Predict ``light.h5``: seven float64 a lobe, three a function of another kind."""
    if settings.method == "srbf_scattered":
        found = 2300 + round(0.92 * 56 * (settings.n_lobes or 0))
        return found if settings.max_bytes is None else min(found, settings.max_bytes)
    functions = (settings.n_centres or 0) + (settings.sh_order or 0) ** 2
    return 2300 + round(0.94 * 24 * (functions + (settings.n_wavelets or 0)))


def frame_bytes(n_parts: int) -> int:
    """Predict what is no array's in ``asset.h5``."""
    return _frame(n_parts, ASSET_ARRAYS) + PROVENANCE_BYTES


def _frame(n_parts: int, more: int) -> int:
    return FILE_BYTES + ARRAY_BYTES * (5 + n_parts * (PART_ARRAYS + more))


def _units(vectors: NDArray[Any]) -> NDArray[np.int16]:
    return np.round(vectors * 32767.0).astype(np.int16)
