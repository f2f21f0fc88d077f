"""All bounces of some coefficients of a scene's transfer: coefficients do not mix, so any will do.

With F one bounce (`separable_bounce`) and T0 the direct transfer, bounce k adds
``D_k = F D_(k-1)``, ``D_0 = T0``.  Where a part scatters light inside, S takes what arrives at it
to what leaves it (`part_scattering`): ``D_k = S F D_(k-1)``, ``D_0 = S T0``.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bounce_casting import BounceCasting
from prtbake_workers.transport.bounce_error import bounce_error, row_norms
from prtbake_workers.transport.part_scattering import PartScattering
from prtbake_workers.transport.separable_bounce import BounceGather
from prtbake_workers.transport.smoothing import Smoothing
from prtbake_workers.transport.surface import OpaqueSurface

MAX_POWERS = 64
"""Further bounces of the scalar majorant that are summed for the bound."""

TAIL_SHARE = 1e-3
"""The majorant is summed until its last term is below this share of it."""

GROWN = 4.0
"""Times the least energy of a bounce so far, above which bounces grow.

Surfaces give back no more light than they get.  But energies here weigh it otherwise from part to
part: rows of a diffuse part are light before its albedo, those of another one radiance weighted by
the view's cosine squared.  Between a white plate and a lossless glossy one they rise about twofold
and fall again.  Twice that is the noise of few rays, and to go on would sum it without end.
Diffuse parts alone hand on means of what they see, which cannot grow.
"""


@dataclass(frozen=True)
class BouncedBlock:
    """What the bounces added to a block of coefficients.

    Energies are squared radiance norms of these coefficients, one a part, area-weighted and summed
    over channels: they add up over blocks.

    Attributes
    ----------
    added
        The sum of all bounces, one array a part; of a part that scatters all that leaves it, the
        direct light included, in place of its direct transfer.
    direct_energy, total_energy
        Of the direct transfer, counted once a channel, and of its sum with what was added; of a
        part that scatters both as they leave it.
    bounce_energies
        Of each bounce by itself, a row a bounce that was added.
    remainder_energy
        Of everything after the last bounce: an upper bound where ``is_bound``, under F as it was
        traced, else an estimate from the last two bounces.  None where bounces do not fade or
        none was asked for.
    grows
        Whether they grew, see `GROWN`, or the last one allowed brought no less than the last but
        two, between parts that are not all diffuse.  None after the least of them is added then.
    noise_energy
        Expected squared error of all bounces from their rays being few and from means over
        neighbours where those are taken, as measured at some vertices, see `bounce_error`.  What
        bounces hand on of it is added as if each drew anew; where they grow, all of it at every
        bounce that is added, since surfaces give back no more than they get.  Of a part that
        scatters at most so much, as scattering evens it out.
    rounds
        Of means over neighbours, a number a part, see `Smoothing`.
    n_rays
        Of each vertex in the first bounce, a number a part.
    counters
        Rays, hits and hits on backs.
    """

    added: tuple[Float32[F32, "_ channels _ coeffs"], ...]
    direct_energy: Float64[F64, " parts"]
    total_energy: Float64[F64, " parts"]
    bounce_energies: Float64[F64, "bounces parts"]
    remainder_energy: Float64[F64, " parts"] | None
    is_bound: bool
    grows: bool
    noise_energy: Float64[F64, " parts"]
    rounds: tuple[int, ...]
    n_rays: tuple[int, ...]
    counters: dict[str, int]


def bounce_block(
    surface: OpaqueSurface,
    direct: Sequence[Float32[F32, "_ _ coeffs"]],
    *,
    factorisations: Sequence[Factorisation],
    albedo: Albedo,
    n_channels: int,
    n_rays: Sequence[int],
    later_rays: Sequence[int] | None = None,
    noise_tolerance: float = 0.0,
    seed: int,
    max_bounces: int,
    tolerance: float,
    scattering: Sequence[PartScattering | None] = (),
    rounds: Sequence[int] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BouncedBlock:
    """Sum the bounces of some coefficients.

    Parameters
    ----------
    surface
        All parts.
    direct
        T0 of every part, (verts, terms, coeffs), whitened, the same for all channels.
    factorisations, albedo, n_channels, seed
        As `BounceGather` takes them.
    n_rays, later_rays
        Of each vertex, a number a part: in the first bounce, and in those after it, which bring
        less; None for the same.
    noise_tolerance
        Squared-error ratio to direct light below which fewer rays do where means are taken, see
        `pilot_rays`; 0 takes all.
    max_bounces
        At most so many, and none after the least of them where they grow, see `BouncedBlock`;
        these are found by bouncing anew, which holds no more.  0 leaves the scattering of
        direct light, and traces no ray.
    tolerance
        Squared-error ratio: bounces stop after the first whose energy, over that of the sum, is
        not above it on any part.  Where every block of coefficients keeps it, so does their whole.
    scattering
        What each part does to the light that arrives at it, None for nothing; empty for no part.
    rounds
        Of means over neighbours, a number a part; None takes those that are measured to lower the
        error most.
    progress
        Called with bounces done and at most to do; those that are found anew are counted on.

    Returns
    -------
    BouncedBlock
        The same bytes for the same arguments on one BLAS thread.

    Raises
    ------
    SettingsError
        A negative number of bounces or tolerance, or what `BounceGather` and `PartScattering`
        refuse.

    Notes
    -----
    The bound holds where all parts are diffuse.  With d_p the norm of row p of the last bounce, the
    norm of row p of what follows is at most ``sum over j >= 1 of (F^j d)_p``, since neither F nor S
    is negative (see `interreflection.bounce_series`); the sum is cut where its terms have sunk to
    `TAIL_SHARE` and its tail is added as a geometric series of its last ratio.

    Memory: the rays (see `BounceGather`), and the block four times a channel.
    """
    if max_bounces < 0:
        raise SettingsError(f"max_bounces must not be negative, got {max_bounces}")
    if not tolerance >= 0.0:
        raise SettingsError(f"tolerance must not be negative, got {tolerance}")
    scene = surface.scene
    casting = BounceCasting(surface, factorisations, albedo, n_channels, seed)
    media = list(scattering) or [None] * len(direct)

    def leaving_first() -> list[F32]:
        return _leaving(media, [np.repeat(one[:, None], n_channels, axis=1) for one in direct])

    sent = leaving_first()
    direct_energy = _energy(scene, sent)
    smoothings = [
        Smoothing.of_part(scene, part, own) if max_bounces and medium is None else None
        for part, (own, medium) in enumerate(zip(factorisations, media, strict=True))
    ]
    if noise_tolerance > 0.0 and max_bounces:
        n_rays = casting.pilot(sent, n_rays, smoothings, noise_tolerance * direct_energy)
        later_rays = None if later_rays is None else np.minimum(later_rays, n_rays).tolist()
    is_bound = all(own.is_constant_phi for own in factorisations)
    numbers = n_rays, n_rays if later_rays is None else later_rays
    series = _Series(scene, casting, media, numbers, sent, tolerance)
    grows = series.run(max_bounces, may_grow=not is_bound, progress=progress)
    if grows:
        least, before = series.least, len(series.energies)
        # the grown ones go before the others come
        del series, sent
        series = _Series(scene, casting, media, numbers, leaving_first(), tolerance)
        series.run(least, may_grow=False, progress=progress, before=before)
    sent, totals, energies, total = series.sent, series.totals, series.energies, series.total
    remainder = None
    if max_bounces and not grows:
        remainder = (
            _majorant(scene, series.gathers, media, sent)
            if is_bound
            else _geometric([direct_energy, *energies])
        )
    # all that bounces were cast from, and what they brought; in place, as blocks are large
    origin = [np.subtract(whole, last, out=last) for whole, last in zip(totals, sent, strict=True)]
    added = [
        np.subtract(whole, one[:, None], out=whole) if medium is None else whole
        for whole, one, medium in zip(totals, direct, media, strict=True)
    ]
    noise, taken = np.zeros(len(direct)), (0,) * len(direct)
    if energies:
        rays = n_rays if later_rays is None else _of_media(media, later_rays, n_rays)
        error = bounce_error(
            scene,
            casting.at_some(origin, media, rays),
            [one if medium is None else None for one, medium in zip(added, media, strict=True)],
            smoothings,
            seed=seed,
            rounds=rounds,
        )
        times = len(energies) if grows else _handed_on([direct_energy, *energies])
        noise, taken = error.energy * times, error.rounds
        added = [
            one if smoothing is None else smoothing.apply(one, number)
            for one, smoothing, number in zip(added, smoothings, taken, strict=True)
        ]
        total = _energy(
            scene,
            [
                one + first[:, None] if medium is None else one
                for one, first, medium in zip(added, direct, media, strict=True)
            ],
        )
    return BouncedBlock(
        added=tuple(added),
        direct_energy=direct_energy,
        total_energy=total,
        bounce_energies=np.reshape(energies, (-1, len(direct))),
        remainder_energy=remainder,
        is_bound=is_bound,
        grows=grows,
        noise_energy=noise,
        rounds=taken,
        n_rays=tuple(n_rays),
        counters=dict(casting.counters),
    )


class _Series:
    """Bounces of what parts send, and their sum."""

    def __init__(
        self,
        scene: Scene,
        casting: BounceCasting,
        media: Sequence[PartScattering | None],
        numbers: tuple[Sequence[int], Sequence[int]],
        sent: list[F32],
        tolerance: float,
    ) -> None:
        """Take rays a vertex of the first bounce and of later ones; ``sent`` changes in place."""
        self._scene, self._casting, self._media = scene, casting, media
        self._numbers, self._tolerance = numbers, tolerance
        self.sent = sent
        self.totals = [one.copy() for one in sent]
        self.total = _energy(scene, sent)
        self.energies: list[F64] = []
        self.gathers: list[BounceGather] = []

    @property
    def least(self) -> int:
        """Bounces up to the one that brings least."""
        return 1 + int(np.argmin([one.sum() for one in self.energies]))

    def run(
        self,
        most: int,
        *,
        may_grow: bool,
        progress: Callable[[int, int], None] | None = None,
        before: int = 0,
    ) -> bool:
        """Add bounces until one is small, or they grow, at most so many; tell whether they do.

        Progress counts on from ``before``.
        """
        first, later = (list(one) for one in self._numbers)
        self.gathers = self._casting.parts(first if most else ())
        while len(self.energies) < most and self.total.any():
            if len(self.energies) == 1 and later != first:
                # the first ones go before the others come
                self.gathers = []
                self.gathers = self._casting.parts(later)
            self.sent[:] = _leaving(self._media, [one.apply(self.sent) for one in self.gathers])
            for whole, one in zip(self.totals, self.sent, strict=True):
                whole += one
            self.energies.append(_energy(self._scene, self.sent))
            self.total = _energy(self._scene, self.totals)
            done = (self.energies[-1] <= self._tolerance * self.total).all()
            if not done and may_grow and self._grow(is_last=len(self.energies) == most):
                return True
            if progress is not None:
                progress(before + len(self.energies), before + most)
            if done:
                return False
        return False

    def _grow(self, *, is_last: bool) -> bool:
        """Whether bounces grow, by the sums of their energies over parts."""
        whole = [float(one.sum()) for one in self.energies]
        # the last but two, as the weights of `GROWN` let every other one rise
        no_less = len(whole) > 2 and whole[-1] >= whole[-3]
        return whole[-1] > GROWN * min(whole) or (is_last and no_less)


def _of_media(
    media: Sequence[PartScattering | None], inside: Sequence[int], outside: Sequence[int]
) -> list[int]:
    """Choose numbers of rays: one for parts that scatter, another for those that do not."""
    return [
        other if medium is None else own
        for medium, own, other in zip(media, inside, outside, strict=True)
    ]


def _leaving(media: Sequence[PartScattering | None], arriving: Sequence[F32]) -> list[F32]:
    """Take what arrives at parts to what leaves them."""
    return [
        one if medium is None else medium.apply(one)
        for medium, one in zip(media, arriving, strict=True)
    ]


def _energy(
    scene: Scene, transfers: Sequence[Float32[F32, "_ channels _ coeffs"]]
) -> Float64[F64, " parts"]:
    return np.array(
        [
            float(scene.areas[start:stop] @ (row_norms(one) ** 2).sum(axis=1))
            for (start, stop), one in zip(scene.part_ranges, transfers, strict=True)
        ]
    )


def _majorant(
    scene: Scene,
    gathers: Sequence[BounceGather],
    media: Sequence[PartScattering | None],
    last: Sequence[F32],
) -> F64 | None:
    """Bound the energy of everything after the last bounce; None where the series does not fade."""
    term = [row_norms(one).astype(np.float32)[:, :, None, None] for one in last]
    bound = [np.zeros_like(one) for one in term]
    before = largest = max(float(one.max(initial=0.0)) for one in term)
    if largest == 0.0:
        return np.zeros(len(gathers))
    for _ in range(MAX_POWERS):
        term = _leaving(media, [gather.apply(term) for gather in gathers])
        for whole, one in zip(bound, term, strict=True):
            whole += one
        now = max(float(one.max(initial=0.0)) for one in term)
        if now <= TAIL_SHARE * max(float(one.max(initial=0.0)) for one in bound):
            ratio = min(now / before, 0.999)
            bound = [whole + one * np.float32(ratio / (1.0 - ratio))
                     for whole, one in zip(bound, term, strict=True)]  # fmt: skip
            return _energy(scene, bound)
        before = now
    return None


def _handed_on(energies: Sequence[Float64[F64, " parts"]]) -> float:
    """Sum a geometric series of the last two energies, whole scenes, over its first term."""
    before, last = (float(one.sum()) for one in energies[-2:])
    return 1.0 / (1.0 - min(last / before, 0.99)) if before > 0.0 else 1.0


def _geometric(energies: Sequence[Float64[F64, " parts"]]) -> F64 | None:
    """Continue the whole scene's last two energies as the squares of a geometric series."""
    last = energies[-1]
    if not last.any():
        return np.zeros_like(last)
    ratio = float(np.sqrt(last.sum() / max(energies[-2].sum(), last.sum())))
    return np.asarray(last * (ratio / (1.0 - ratio)) ** 2) if ratio < 1.0 else None
