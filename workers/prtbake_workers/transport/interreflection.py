"""Diffuse interreflection: bounces of transfer summed until the next one no longer matters.

With F one bounce (`bounce_operator`) and T0 the direct transfer, ``T^(k+1) = T0 + F T^(k)``: bounce
k adds ``D_k = F D_(k-1)``, ``D_0 = T0``, and what is left after K bounces is ``R = sum over j >= 1
of F^j D_K``.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import B8, F32, F64, Bool, Float32, Float64

COLUMNS_PER_PRODUCT = 256
"""Coefficients multiplied at a time; they do not mix, so a bounce needs no second copy of all."""

MAX_POWERS = 256
"""Powers of F tried for one whose norm is below 1/2, and terms of the majorant summed."""

TAIL_SHARE = 1e-3
"""The majorant is summed until its own tail is below this share of it."""


@dataclass(frozen=True)
class BounceReport:
    """What the bounces added and what they leave.

    Attributes
    ----------
    n_bounces
        K, bounces in the result.
    added
        Squared radiance norm of each bounce over that of the sum up to it: area-weighted over the
        surface, over the sphere of distant light, over all channels.
    remainder
        Upper bound of the same ratio for everything after the last bounce, under F as it was
        traced; None where none exists.
    converged
        Whether the last bounce fell below the tolerance.
    messages
        What a reader of the report must know.
    """

    n_bounces: int
    added: tuple[float, ...]
    remainder: float | None
    converged: bool
    messages: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Give the report as JSON."""
        return asdict(self)


@dataclass(frozen=True)
class BounceSeries:
    """Transfer with its bounces, one row of coefficients a channel and vertex."""

    transfer: Float32[F32, "channels verts coeffs"]
    report: BounceReport


def bounce_series(
    direct: Float32[F32, "verts coeffs"],
    operators: Sequence[Any],
    *,
    areas: Float64[F64, " verts"],
    tolerance: float,
    max_bounces: int,
) -> BounceSeries:
    """Sum the bounces of diffuse transfer.

    Parameters
    ----------
    direct
        T0 = (1/pi) V max(0, n . w) in whitened coefficients, without the vertex's own albedo; any
        linear functional of it will do, such as its value under one light.
    operators
        F, square and sparse, one a channel of the bounced light.
    areas
        Of the vertices, for the norms.
    tolerance
        Squared-error ratio: bounces stop after the first whose added energy, over the energy of
        the sum, is not above it.
    max_bounces
        They stop after this many in any case; 0 gives the direct transfer and the bound on what
        it lacks.

    Returns
    -------
    BounceSeries
        The direct transfer itself where F is empty.

    Raises
    ------
    SettingsError
        Shapes that do not fit, a negative tolerance or count.

    Notes
    -----
    The bound.  Let ``d_p`` be the radiance norm of row p of D_K.  F is not negative, so by the
    triangle inequality the norm of row p of R is at most ``r_p = sum over j >= 1 of (F^j d)_p``: a
    scalar series bounds the series of transfers, vertex by vertex, at the cost of one coefficient.
    Its first M terms are summed.  For the others let S be the vertices that light of d reaches,
    F_S the rows and columns of S, and ``s_i = ||F_S^i||_inf``, the largest entry of ``F_S^i 1``,
    since F is not negative.  If s_m < 1 for some m then, norms of products being at most products
    of norms,

        sum over j > M of F^j d <= ||F^M d||_inf (s_1 + ... + s_m) / (1 - s_m).

    With m = 1 this is the geometric series of the largest row sum, at most the largest albedo;
    higher m see that light leaves through openings which single vertices do not see, so that
    albedo 1 has a bound too wherever light can get out.  The ratio reported is the area-weighted
    sum of r_p^2 over the squared norm of the result.  Rounding of float32 products is added to
    every s_i and every term.

    Memory: the result, as much again for the last bounce, and `COLUMNS_PER_PRODUCT` columns.
    """
    _check(direct, operators, tolerance, max_bounces)
    transfer = np.repeat(direct[None], len(operators), axis=0)
    if not any(matrix.nnz for matrix in operators) or not direct.any():
        return BounceSeries(transfer, BounceReport(0, (), 0.0, True, ()))
    bounces = [_split(direct) for _ in operators]
    norms = np.tile(_squared_norms(bounces[0]), (len(operators), 1))
    total = float((norms @ areas).sum())
    added: list[float] = []
    converged = False
    while len(added) < max_bounces and not converged:
        for channel, matrix in enumerate(operators):
            _bounce(matrix, bounces[channel])
            _add(transfer[channel], bounces[channel])
            norms[channel] = _squared_norms(bounces[channel])
        total = sum(float(np.vecdot(rows, rows).astype(np.float64) @ areas) for rows in transfer)
        added.append(float((norms @ areas).sum()) / (total or 1.0))
        converged = added[-1] <= tolerance
    left = 0.0
    unbounded = False
    for matrix, squared in zip(operators, norms, strict=True):
        bound = remainder_bound(matrix, np.sqrt(squared))
        unbounded |= bound is None
        left += 0.0 if bound is None else float(areas @ bound**2)
    remainder = None if unbounded else left / (total or 1.0)
    messages = _messages(added, remainder, converged, tolerance, max_bounces)
    report = BounceReport(len(added), tuple(added), remainder, converged, messages)
    return BounceSeries(transfer, report)


def remainder_bound(matrix: Any, last: Float64[F64, " verts"]) -> Float64[F64, " verts"] | None:
    """Bound the norm of everything after a bounce, vertex by vertex, from that bounce's norms.

    See `bounce_series` for the proof; None where no power of the operator up to `MAX_POWERS` takes
    light away, as with albedo 1 in a closed space.
    """
    rounding = _rounding(matrix)
    lit = _reached(matrix, last > 0.0)
    growth = _growth(matrix, lit, rounding)
    if growth is None:
        return None
    # to the size of 1, where float32 neither overflows nor vanishes
    scale = float(last.max(initial=0.0)) or 1.0
    term = (last / scale).astype(np.float32)
    bound, tail = np.zeros(len(last)), 0.0
    for _ in range(MAX_POWERS):
        term = (matrix @ term) * np.float32(rounding)
        bound += term
        tail = float(term.max(initial=0.0)) * growth
        if tail <= TAIL_SHARE * bound.max(initial=0.0):
            break
    return scale * (bound + tail * lit)


def _reached(matrix: Any, lit: Bool[B8, " verts"]) -> Bool[B8, " verts"]:
    """Find the vertices that light of the lit ones reaches in any number of bounces."""
    while True:
        wider = lit | (matrix @ lit.astype(np.float32) > 0.0)
        if (wider == lit).all():
            return lit
        lit = wider


def _growth(matrix: Any, lit: Bool[B8, " verts"], rounding: float) -> float | None:
    """Bound the sum of ||F_S^i||_inf over i >= 1; None where no power falls below 1."""
    ones = lit.astype(np.float32)
    norm = total = 0.0
    for _ in range(MAX_POWERS):
        ones = (matrix @ ones) * np.float32(rounding)
        norm = float(ones.max(initial=0.0))
        total += norm
        if norm < 0.5:
            break
    return total / (1.0 - norm) if norm < 1.0 else None


def _rounding(matrix: Any) -> float:
    """Give the factor that covers the rounding of a float32 sum over the longest row."""
    longest = int(np.diff(matrix.indptr).max(initial=0))
    return 1.0 + (longest + 2) * float(np.finfo(np.float32).eps)


def _split(direct: Float32[F32, "verts coeffs"]) -> list[Float32[F32, "verts _"]]:
    """Copy columns into blocks."""
    return [
        np.array(direct[:, start : start + COLUMNS_PER_PRODUCT], order="C")
        for start in range(0, direct.shape[1], COLUMNS_PER_PRODUCT)
    ]


def _bounce(matrix: Any, blocks: list[Float32[F32, "verts _"]]) -> None:
    for index, block in enumerate(blocks):
        blocks[index] = matrix @ block


def _add(transfer: Float32[F32, "verts coeffs"], blocks: list[Float32[F32, "verts _"]]) -> None:
    for index, block in enumerate(blocks):
        start = index * COLUMNS_PER_PRODUCT
        transfer[:, start : start + COLUMNS_PER_PRODUCT] += block


def _squared_norms(blocks: list[Float32[F32, "verts _"]]) -> Float64[F64, " verts"]:
    """Sum squares over coefficients: rows of a block in float32, the blocks in float64."""
    return np.asarray(sum(np.vecdot(block, block).astype(np.float64) for block in blocks))


def _messages(
    added: list[float],
    remainder: float | None,
    converged: bool,
    tolerance: float,
    max_bounces: int,
) -> tuple[str, ...]:
    messages = []
    if not converged:
        last = f"the last of them added {added[-1]:.1e}" if added else "none was traced"
        messages.append(
            f"stopped at max_bounces = {max_bounces} before the tolerance {tolerance:.1e}: {last}"
        )
    if remainder is None:
        messages.append(
            "there is no bound on what the bounces leave out: some light never gets out "
            "(albedo 1 in a closed space)"
        )
    elif remainder > tolerance:
        messages.append(
            f"the bounces left out may add up to {remainder:.1e}, above the tolerance "
            f"{tolerance:.1e}"
        )
    return tuple(messages)


def _check(direct: F32, operators: Sequence[Any], tolerance: float, max_bounces: int) -> None:
    if len(operators) not in (1, 3):
        raise SettingsError(f"bounces take one operator or three, not {len(operators)}")
    n = len(direct)
    for channel, matrix in enumerate(operators):
        if matrix.shape != (n, n):
            raise SettingsError(
                f"the operator of channel {channel} is {matrix.shape[0]} x {matrix.shape[1]}, "
                f"the transfer has {n} vertices"
            )
        if matrix.nnz and float(matrix.data.min()) < 0.0:
            raise SettingsError(f"the operator of channel {channel} has a negative entry")
    if not tolerance >= 0.0:
        raise SettingsError(f"tolerance must not be negative, got {tolerance}")
    if max_bounces < 0:
        raise SettingsError(f"max_bounces must not be negative, got {max_bounces}")
    if not np.isfinite(direct).all():
        vertex, coeff = np.argwhere(~np.isfinite(direct))[0].tolist()
        raise SettingsError(f"coefficient {coeff} of the transfer to vertex {vertex} is not finite")
