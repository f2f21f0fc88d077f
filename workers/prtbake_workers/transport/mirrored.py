"""The projection's product in parts that a mirror and the inversion of all directions keep apart.

A cube map of even resolution and an icosphere (or spherical harmonics) look the same mirrored in
z and turned inside out.  Sums and differences of samples in directions that a symmetry swaps then
reach only the even or only the odd combinations of coefficients: half of the product's
multiplications, a quarter of the residual's.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array, vstack

from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.basis.projection import LeastSquaresProjection
from prtbake_workers.transport.left_side import Workspace
from prtbake_workers.transport.plain_product import PLAIN, PickedDirections, PlainProduct
from prtbake_workers.transport.symmetry import Image, image_of

CACHED_ROWS = 48
"""Rows of coefficients unfolded at a time: at 642, arrays that are not mapped anew each time."""

COMBINED_ROWS = 1024
"""Directions whose columns are combined at a time: 21 MB each array at 2562 functions."""

MIRRORED = "mirrored"
_ARRAYS = ("orbits", "matrix", "twos", "ones", "places")

PARITIES = np.array([[1, -1], [1, 1], [-1, -1], [-1, 1]])
"""Of the four blocks of combinations: signs under the mirror and under the inversion."""


@dataclass(frozen=True)
class MirroredProduct:
    """A projection in combinations of coefficients that are even or odd under two symmetries.

    ``t = s P = (s P') E^T`` with entries 0 and +-1 in E, ``P' = P E (E^T E)^-1``.

    Attributes
    ----------
    orbits
        Directions d, mirrored M d, inverted -d and -M d, one column each four.
    matrix
        P' over the root weights; the first block of columns again at the end.
    offsets
        Where the blocks of `PARITIES` start, and their end.
    quadratic
        For each block the residual's quadratic form less the identity's.
    fours, twos, ones
        Combinations that make four coefficients (one in each block), two, or are one.
    places, signs
        Where in that order each coefficient is found, and its sign; None if all are positive.
    """

    orbits: Int64[I64, "4 orbits"]
    matrix: Float32[F32, "dirs wide"]
    offsets: tuple[int, ...]
    quadratic: tuple[F32, ...]
    fours: int
    twos: Int64[I64, "2 pairs"]
    ones: Int64[I64, " ones"]
    places: Int64[I64, " coeffs"]
    signs: Float32[F32, " coeffs"] | None

    @classmethod
    def of(
        cls, projection: LeastSquaresProjection, directions: Float64[F64, "dirs 3"]
    ) -> "MirroredProduct | None":
        """Find a mirror and the inversion in a projection; None where it lacks them."""
        inverted = image_of(projection, directions, -np.ones(3))
        mirrored = image_of(projection, directions, np.array([1.0, 1.0, -1.0]))
        if inverted is None or mirrored is None:
            return None
        # what their product leaves in place would be paired with itself
        if (mirrored.directions == inverted.directions).any():
            return None
        return _product(projection, mirrored, inverted)

    @classmethod
    def from_tables(
        cls, arrays: Mapping[str, NDArray[Any]], numbers: Mapping[str, Any]
    ) -> "MirroredProduct":
        """Read back what `tables` gave."""
        offsets = tuple(numbers["offsets"])
        return cls(
            offsets=offsets,
            quadratic=tuple(arrays[f"quadratic_{block}"] for block in range(len(PARITIES))),
            fours=numbers["fours"],
            signs=arrays.get("signs"),
            **{name: arrays[name] for name in _ARRAYS},
        )

    def tables(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Give arrays and numbers that `from_tables` makes the product of again."""
        arrays: dict[str, NDArray[Any]] = {name: getattr(self, name) for name in _ARRAYS}
        arrays |= {f"quadratic_{block}": own for block, own in enumerate(self.quadratic)}
        if self.signs is not None:
            arrays["signs"] = self.signs
        return arrays, {"kind": MIRRORED, "offsets": self.offsets, "fours": self.fours}

    def pick(self, directions: Int64[I64, " seen"]) -> PickedDirections:
        """Pair the directions that a group sees; partners that it does not see are added.

        The runs of pairs are of directions and their mirror images, and of directions and the same
        turned by 180 degrees about z.
        """
        seen = np.zeros(len(self.matrix), np.bool_)
        seen[directions] = True
        here, mirrored, inverted, turned = seen[self.orbits]
        by_mirror = np.stack([here | mirrored, inverted | turned])
        by_turn = np.stack([here | turned, inverted | mirrored])
        mirror = by_mirror.sum(axis=0) <= by_turn.sum(axis=0)
        d, m, i, t = self.orbits
        runs, matrices = [], []
        for wanted, partners in ((by_mirror & mirror, (m, t)), (by_turn & ~mirror, (t, m))):
            firsts = np.concatenate([d[wanted[0]], i[wanted[1]]])
            runs += [firsts, partners[0][wanted[0]], partners[1][wanted[1]]]
            matrices.append(self.matrix.take(firsts, axis=0))
        n_pairs = len(matrices[0]), len(matrices[1])
        return PickedDirections(np.concatenate(runs), n_pairs, (matrices[0], matrices[1]))

    def multiply(
        self, terms: Float32[F32, "terms verts dirs"], picked: PickedDirections, work: Workspace
    ) -> Float32[F32, "terms verts coeffs"]:
        """Project folded samples, see `fold_pairs`, on the combinations; kept in a buffer."""
        rows = terms.reshape(-1, terms.shape[2])
        (n, m), (by_mirror, by_turn) = picked.n_pairs, picked.matrices
        _, first, second, third, end = self.offsets
        wide = self.matrix.shape[1]
        product = work.array("product", (len(rows), end))
        np.matmul(rows[:, :n], by_mirror[:, :second], out=product[:, :second])
        np.matmul(rows[:, n : 2 * n], by_mirror[:, second:end], out=product[:, second:])
        if m:
            # turned by 180 degrees, the two blocks of equal signs are even
            turned, odd = rows[:, 2 * n : 2 * n + m], rows[:, 2 * n + m :]
            other = work.array("other", (len(rows), wide - first))
            np.matmul(turned, by_turn[:, first:third], out=other[:, : third - first])
            np.matmul(odd, by_turn[:, third:], out=other[:, third - first :])
            product[:, first:] += other[:, : end - first]
            product[:, :first] += other[:, end - first :]
        return product.reshape(*terms.shape[:2], end)

    def unfold(
        self,
        product: Float32[F32, "terms verts coeffs"],
        out: Float32[F32, "block terms coeffs"],
        rows: Int64[I64, " verts"],
        work: Workspace,
    ) -> Float64[F64, " verts"]:
        """Write the coefficients to rows of ``out`` and return the energy that they explain.

        That is `explained_energy`, block by block.
        """
        n_terms, n_verts, n_coeffs = product.shape
        explained = np.zeros(n_verts)
        flat = product.reshape(-1, n_coeffs)
        for block, quadratic in enumerate(self.quadratic):
            own = flat[:, self.offsets[block] : self.offsets[block + 1]]
            image = work.array("image", own.shape)
            np.matmul(own, quadratic, out=image)
            explained += np.vecdot(image, own).reshape(n_terms, n_verts).sum(axis=0, dtype=float)
        step = max(1, CACHED_ROWS // n_terms)
        for start in range(0, n_verts, step):
            part = slice(start, start + step)
            coefficients = self._coefficients(product[:, part].transpose(1, 0, 2))
            explained[part] += np.vecdot(coefficients, coefficients).sum(axis=1, dtype=float)
            out[rows[part]] = coefficients
        return explained

    def _coefficients(self, folded: F32) -> F32:
        """Undo the combinations: E^T."""
        unfolded = np.empty(folded.shape, np.float32)
        even_odd, even, odd, odd_even = (
            folded[..., start : start + self.fours] for start in self.offsets[:4]
        )
        d, m, i, t = (unfolded[..., k * self.fours : (k + 1) * self.fours] for k in range(4))
        up, down = even + even_odd, even - even_odd
        left, right = odd_even + odd, odd_even - odd
        np.add(up, left, out=d)
        np.subtract(up, left, out=m)
        np.add(down, right, out=i)
        np.subtract(down, right, out=t)
        start, n_twos = 4 * self.fours, self.twos.shape[1]
        one, other = folded.take(self.twos[0], axis=2), folded.take(self.twos[1], axis=2)
        np.add(one, other, out=unfolded[..., start : start + n_twos])
        np.subtract(one, other, out=unfolded[..., start + n_twos : start + 2 * n_twos])
        unfolded[..., start + 2 * n_twos :] = folded.take(self.ones, axis=2)
        coefficients = unfolded.take(self.places, axis=2)
        if self.signs is not None:
            coefficients *= self.signs
        return coefficients


Product = PlainProduct | MirroredProduct


def product_of(projection: LeastSquaresProjection, directions: Float64[F64, "dirs 3"]) -> Product:
    """Give the mirrored product where there is one, else the plain one."""
    return MirroredProduct.of(projection, directions) or PlainProduct.of(projection)


def product_from_tables(arrays: Mapping[str, NDArray[Any]], numbers: Mapping[str, Any]) -> Product:
    """Read back what the ``tables`` of either product gave."""
    kinds: dict[str, type[Product]] = {MIRRORED: MirroredProduct, PLAIN: PlainProduct}
    return kinds[numbers["kind"]].from_tables(arrays, numbers)


def _product(
    projection: LeastSquaresProjection, mirrored: Image, inverted: Image
) -> MirroredProduct:
    (m, move_m, sign_m), (i, move_i, sign_i) = mirrored, inverted
    own = np.arange(projection.n_coeffs)
    images = np.stack([own, move_m, move_i, move_i[move_m]])
    signs = np.stack([np.ones(len(own)), sign_m, sign_i, sign_m * sign_i[move_m]])
    size = np.array([len(np.unique(column)) for column in images.T])
    first = images.min(axis=0) == own
    fours, twos, ones = (np.flatnonzero(first & (size == n)) for n in (4, 2, 1))
    # the one of a pair's images that is the other function
    swap = np.argmax(images[:, twos] != twos, axis=0)
    partners, partner_signs = images[swap, twos], signs[swap, twos]
    rest = projection.rest
    offsets, quadratic, combinations = [0], [], []
    pair_columns, single_columns = np.empty((2, len(twos)), np.int64), ones.copy()
    for parity in PARITIES:
        character = np.array([1, *parity, parity.prod()])
        weights = character[:, None] * signs
        kept = np.where(images == own, weights, 0.0).sum(axis=0) > 0.0
        columns = np.concatenate([fours, twos[kept[twos]], ones[kept[ones]]])
        at = offsets[-1] + np.arange(len(columns))
        n_fours, n_twos = len(fours), int(kept[twos].sum())
        which = np.flatnonzero(kept[twos])
        pair_columns[np.where(character[swap[which]] > 0, 0, 1), which] = at[n_fours:][:n_twos]
        single_columns[kept[ones]] = at[n_fours + n_twos :]
        # a function that symmetries leave in place is met several times
        entries = weights[:, columns] * (size[columns] / 4.0)
        place = np.broadcast_to(np.arange(len(columns)), entries.shape)
        combine = csr_array(
            (entries.ravel(), (place.ravel(), images[:, columns].ravel())),
            shape=(len(columns), len(own)),
        )
        combinations.append(diags_array(1.0 / size[columns]) @ combine)
        quadratic.append((combine @ (combine @ rest).T).astype(np.float32))
        offsets.append(offsets[-1] + len(columns))
    order = np.concatenate([images[:, fours].ravel(), twos, partners, ones])
    order_signs = np.concatenate(
        [signs[:, fours].ravel(), np.ones(len(twos)), partner_signs, np.ones(len(ones))]
    )
    places = np.argsort(order)
    final = order_signs[places].astype(np.float32)
    here = np.arange(len(m))
    orbits = np.stack([here, m, i, i[m]])
    return MirroredProduct(
        orbits=orbits[:, orbits.min(axis=0) == here],
        matrix=_combined(projection, vstack([*combinations, combinations[0]], format="csr")),
        offsets=tuple(offsets),
        quadratic=tuple(quadratic),
        fours=len(fours),
        twos=pair_columns,
        ones=single_columns,
        places=places,
        signs=None if (final > 0.0).all() else final,
    )


def _combined(projection: LeastSquaresProjection, combine: csr_array) -> Float32[F32, "dirs wide"]:
    """Combine columns of the projection, some directions at a time."""
    matrix = np.empty((len(projection.weights), combine.shape[0]), np.float32)
    for start in range(0, len(matrix), COMBINED_ROWS):
        rows = slice(start, start + COMBINED_ROWS)
        weighted = projection.matrix[rows] / np.sqrt(projection.weights[rows, None])
        matrix[rows] = (combine @ weighted.T).T
    return matrix
