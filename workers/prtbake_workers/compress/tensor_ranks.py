"""Which view, light and vertex ranks each cluster of tensors gets of a storage that all share.

The core of a cluster's higher-order SVD tells what any smaller ranks would capture: the energy of
its leading block, as the bases of all modes are orthonormal.  The storage is divided by a price for
a number: at one price each cluster takes the ranks that are worth most to it, and no other ranks of
as many numbers together capture more (Everett's theorem on Lagrange multipliers).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64, Int64

PRICE_STEPS = 48
"""Halvings of the interval that the price lies in, in its logarithm."""

LOWEST_PRICE = 1e-16
"""Share of all energy that a number has to capture at least: less is rounding."""


MOST_STEPS = 32
"""Ranks of a mode that a cluster may choose among, evenly spread: tables of all would outgrow the
transfer."""


@dataclass(frozen=True)
class RankChoices:
    """What a cluster's ranks capture and cost.

    Attributes
    ----------
    ranks
        Ranks of the view, the light and the vertices to choose among, rising.
    captured
        Squared norm of the cluster that they hold, rising along each axis.  No entries for a
        cluster that holds nothing.
    n_verts, n_coeffs, n_channels
        A vertex rank has a number for each vertex, a light rank for each coefficient of the light;
        a dual basis has them all for each view row of each channel.
    """

    ranks: tuple[I64, I64, I64]
    captured: Float64[F64, "view light vert"]
    n_verts: int
    n_coeffs: int
    n_channels: int

    @property
    def numbers(self) -> Float64[F64, "view light vert"]:
        """Numbers that the ranks store."""
        view, light, vert = np.ix_(*(own.astype(np.float64) for own in self.ranks))
        dual = self.n_channels * view * light * vert
        return np.asarray(self.n_coeffs * light + dual + self.n_verts * vert)


class TensorAllocation(NamedTuple):
    """Ranks of each cluster.

    Attributes
    ----------
    ranks
        (view, light, vert); zeros for a cluster that is worth no number.
    numbers
        That they store together.
    price
        Squared norm that a number captures at least; the lowest there is, where all was affordable.
    """

    ranks: Int64[I64, "clusters 3"]
    numbers: float
    price: float


def rank_choices(
    core: Float64[F64, "vert channels view light"], n_verts: int, n_coeffs: int
) -> RankChoices:
    """Return what leading blocks of a core hold and cost.

    Parameters
    ----------
    core
        Of a cluster's higher-order SVD: its tensor in orthonormal bases, strongest vectors first.
    n_verts, n_coeffs
        Vertices of the cluster and coefficients of the light.
    """
    captured = np.square(core).sum(axis=1).transpose(1, 2, 0)
    for axis in range(3):
        captured = captured.cumsum(axis=axis)
    view, light, vert = (_spread(size) for size in captured.shape)
    chosen = np.ascontiguousarray(captured[np.ix_(view - 1, light - 1, vert - 1)])
    return RankChoices((view, light, vert), chosen, n_verts, n_coeffs, core.shape[1])


def _spread(most: int) -> I64:
    """Return ranks from 1 to ``most``, all or `MOST_STEPS` of them."""
    return np.unique(np.linspace(1.0, most, min(most, MOST_STEPS)).round().astype(np.int64))


def allocate_tensor_ranks(clusters: Sequence[RankChoices], budget: float) -> TensorAllocation:
    """Choose the ranks of all clusters that capture most in at most ``budget`` numbers.

    Choices lie on the convex hull of what each cluster's ranks capture over what they cost.  What
    the last step leaves of the budget goes to those clusters whose next choice fits.
    """
    total = sum(float(own.captured.max(initial=0.0)) for own in clusters)
    low, high = LOWEST_PRICE * total, total
    cheap = [_at(own, low) for own in clusters]
    if _numbers(cheap) <= budget:
        return TensorAllocation(_ranks(cheap, clusters), _numbers(cheap), low)
    dear = [_at(own, high) for own in clusters]
    for _ in range(PRICE_STEPS):
        price = float(np.sqrt(low * high))
        found = [_at(own, price) for own in clusters]
        if _numbers(found) <= budget:
            high, dear = price, found
        else:
            low, cheap = price, found
    left = budget - _numbers(dear)
    for index, (now, more) in enumerate(zip(dear, cheap, strict=True)):
        if 0.0 < more.numbers - now.numbers <= left:
            left -= more.numbers - now.numbers
            dear[index] = more
    return TensorAllocation(_ranks(dear, clusters), _numbers(dear), high)


class _Choice(NamedTuple):
    """A place in a cluster's choices, -1 for no ranks at all, and its numbers."""

    place: int
    numbers: float


NONE = _Choice(-1, 0.0)


def _at(own: RankChoices, price: float) -> _Choice:
    """Return the choice that is worth most over its price."""
    if own.captured.size == 0:
        return NONE
    numbers = own.numbers
    worth = own.captured - price * numbers
    place = int(np.argmax(worth))
    return _Choice(place, float(numbers.flat[place])) if worth.flat[place] > 0.0 else NONE


def _numbers(choices: Sequence[_Choice]) -> float:
    return sum(choice.numbers for choice in choices)


def _ranks(choices: Sequence[_Choice], clusters: Sequence[RankChoices]) -> I64:
    ranks = np.zeros((len(clusters), 3), dtype=np.int64)
    for own, choice, of in zip(ranks, choices, clusters, strict=True):
        if choice.place >= 0:
            place = np.unravel_index(choice.place, of.captured.shape)
            own[:] = [steps[index] for steps, index in zip(of.ranks, place, strict=True)]
    return ranks
