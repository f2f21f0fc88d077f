"""How many directions and functions transport needs: tried on a few vertices.

The squared error of a projection has two sources, what the basis cannot hold and what the sampled
directions miss.  Both show in directions that the fit has not seen: see `held_out`.  Here they are
measured there for every candidate, before anything is baked.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from prtbake_storage.contract.settings import BakeSettings
from prtbake_workers.arrays import F32, F64, Float64
from prtbake_workers.basis.srbf import default_bandwidth
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.cost import probe_memory_bytes
from prtbake_workers.planning.decision import Decision
from prtbake_workers.planning.plan import resolves
from prtbake_workers.planning.presets import PlannedBake
from prtbake_workers.planning.sampled_transfer import ProbeDirections, SampledTransfer
from prtbake_workers.planning.trial_basis import TrialBasis

EFFECT = "light_resolution"

CENTRES = (12, 42, 162, 642, 2562)
"""Those of the icosphere for 0, 1, ... subdivisions."""

RESOLUTIONS = (8, 12, 16, 24, 32, 48)
"""Of the cube map; the last resolves 2562 centres."""

VERTICES, MOST_OF_A_PART, FEWEST_OF_A_PART = 384, 128, 16
"""Looked at in all, unless the fewest of every part are more, and of one part.  128 tell its error
within about a tenth."""

MOST_RAYS = 100_000_000
"""Traced in all, half a minute's: more supersamples leave fewer vertices, to the fewest."""

HELD_OUT_RESOLUTION = 16
"""Of the cube map that is turned at random: 1536 directions."""


@dataclass(frozen=True)
class Candidate:
    """A number of centres and a cube resolution, and what they leave of each part's transport.

    ``of_basis`` is the share of it that the finest cube map leaves, too.
    """

    n_centres: int
    cube_resolution: int
    errors: tuple[float, ...]
    of_basis: tuple[float, ...]

    @property
    def worst(self) -> int:
        """The part that most is left of."""
        return int(np.argmax(self.errors))

    @property
    def error(self) -> float:
        """What is left of the worst part."""
        return self.errors[self.worst]

    def to_dict(self) -> dict[str, Any]:
        """Give numbers and the errors of the worst part as JSON."""
        return {
            "n_centres": self.n_centres,
            "cube_resolution": self.cube_resolution,
            "error": self.error,
            "of_basis": self.of_basis[self.worst],
        }


@dataclass(frozen=True)
class LightResolution:
    """Settings with nothing left open, why they are what they are, and what a report should say.

    ``memory_bytes`` is what trying is predicted to have held, see `probe_memory_bytes`, ``work``
    what it did: the amounts of `plan_work` for trials.
    """

    bake: PlannedBake
    decision: Decision
    notes: tuple[str, ...]
    memory_bytes: int
    work: dict[str, float]


def candidates(bake: BakeSettings) -> dict[int, tuple[int, ...]]:
    """List numbers of centres, rising, and the cube resolutions that resolve each.

    A resolution that is given and resolves none is listed with the fewest centres.
    """
    centres = (bake.n_centres,) if isinstance(bake.n_centres, int) else CENTRES
    given = bake.cube_resolution
    resolutions = (given,) if isinstance(given, int) else RESOLUTIONS
    found = {count: tuple(one for one in resolutions if resolves(one, count)) for count in centres}
    return {count: fine for count, fine in found.items() if fine} or {centres[0]: resolutions}


def choose_light_resolution(
    scene: Scene,
    occluders: Sequence[Accelerator | None],
    factorisations: Sequence[Factorisation],
    bake: BakeSettings,
    *,
    names: Sequence[str],
    seed: int,
) -> LightResolution:
    """Choose the numbers that a bake leaves open.

    The fewest centres, and with these the coarsest cube map, that are predicted to leave no part
    more than the tolerance: everything after the bake grows with the centres.  Where none does, the
    pair that leaves least.  Centres are tried from few to many, and none beyond the choice.

    Parameters
    ----------
    scene
        All parts.
    occluders, factorisations, names
        Of each part, as the bake will have them.
    bake
        Settings of which ``cube_resolution``, ``n_centres`` or both are ``auto``.
    seed
        Chooses vertices and directions.

    Notes
    -----
    A tighter tolerance never takes fewer centres, nor a coarser cube map for as many: it has fewer
    candidates to take, in the same order.  Black parts are left out: nothing of them is seen.  BLAS
    runs on one thread, so that the evidence is the same bytes everywhere.
    """
    rng = np.random.default_rng(seed)
    probed = _probed(scene, occluders, factorisations, bake, rng)
    tolerance = bake.projection_tolerance
    tried: list[Candidate] = []
    with threadpool_limits(limits=1, user_api="blas"):
        trials = _Trials(probed, bake, rng)
        for n_centres in trials.resolutions:
            tried += trials.candidates_of(n_centres)
            if any(one.error <= tolerance for one in tried):
                break
    chosen = pick(tried, tolerance)
    words = _in_words(chosen, tolerance, names)
    return LightResolution(
        PlannedBake.model_validate(
            bake.model_dump()
            | {"n_centres": chosen.n_centres, "cube_resolution": chosen.cube_resolution}
        ),
        Decision(
            effect=EFFECT,
            taken=True,
            forced=False,
            reason=words,
            evidence={
                "tolerance": tolerance,
                "predicted_error": chosen.error,
                "predicted_error_of": dict(zip(names, chosen.errors, strict=True)),
                "probe_vertices": sum(part.n_vertices for part in probed),
                "candidates": [one.to_dict() for one in tried],
            },
            predicted_error_otherwise=min(
                (one.error for one in tried[: tried.index(chosen)]), default=None
            ),
        ),
        () if chosen.error <= tolerance else (words,),
        probe_memory_bytes(
            n_functions=trials.n_functions,
            n_directions=trials.n_directions,
            n_coeffs=tried[-1].n_centres,
        ),
        {"trial_rays": float(trials.n_rays), "trial_flops": trials.flops},
    )


def try_light_resolutions(
    scene: Scene,
    occluders: Sequence[Accelerator | None],
    factorisations: Sequence[Factorisation],
    bake: BakeSettings,
    *,
    resolutions: Mapping[int, tuple[int, ...]],
    worth_trying: Callable[[int, Sequence[Candidate], Mapping[str, float]], bool],
    seed: int,
) -> list[Candidate]:
    """Measure what pairs of centres and cube maps leave, without choosing one.

    Parameters
    ----------
    scene, occluders, factorisations, bake, seed
        As `choose_light_resolution` takes them.
    resolutions
        Of the cube maps to try with each number of centres; these rise.
    worth_trying
        Whether a number of centres is to be tried, and those above it, after what was tried and for
        what all of it will have taken then: the amounts of `plan_work` for trials.
    """
    rng = np.random.default_rng(seed)
    probed = _probed(scene, occluders, factorisations, bake, rng)
    tried: list[Candidate] = []
    with threadpool_limits(limits=1, user_api="blas"):
        trials = _Trials(probed, bake, rng, resolutions)
        for n_centres in resolutions:
            if not worth_trying(n_centres, tried, trials.work_with(n_centres)):
                break
            tried += trials.candidates_of(n_centres)
    return tried


def _probed(
    scene: Scene,
    occluders: Sequence[Accelerator | None],
    factorisations: Sequence[Factorisation],
    bake: BakeSettings,
    rng: np.random.Generator,
) -> list[SampledTransfer]:
    """Draw the vertices that are looked at, none of black parts."""
    seen = [not own.is_black for own in factorisations]
    count = _vertices_of_a_part(bake, max(1, sum(seen)))
    return [
        SampledTransfer.of(
            scene, part, own, occluders[part], count=count if seen[part] else 0, rng=rng
        )
        for part, own in enumerate(factorisations)
    ]


def _vertices_of_a_part(bake: BakeSettings, n_parts: int) -> int:
    resolutions = {RESOLUTIONS[-1]}.union(*candidates(bake).values())
    rays = 3 * sum(one**2 for one in resolutions) * bake.supersample**2
    affordable = min(MOST_OF_A_PART, VERTICES // n_parts, MOST_RAYS // (rays * n_parts))
    return max(FEWEST_OF_A_PART, affordable)


def pick(tried: Sequence[Candidate], tolerance: float) -> Candidate:
    """Take the first within the tolerance; where none is, the one that leaves least."""
    for one in tried:
        if one.error <= tolerance:
            return one
    return min(tried, key=lambda one: one.error)


def _in_words(chosen: Candidate, tolerance: float, names: Sequence[str]) -> str:
    """Say what was chosen; where that leaves too much, what it is that leaves it."""
    of_part = f" of {names[chosen.worst]}'s transport" if len(names) > 1 else " of the transport"
    words = (
        f"{chosen.n_centres} centres and 6 x {chosen.cube_resolution}^2 directions are predicted "
        f"to leave {chosen.error:.1e}{of_part}"
    )
    if chosen.error <= tolerance:
        return f"{words}: the fewest that leave no more than {tolerance:g}"
    return (
        f"{words}, {chosen.of_basis[chosen.worst]:.1e} of it whatever the directions: no more "
        f"centres or directions were allowed, and projection_tolerance {tolerance:g} is not reached"
    )


class _Trials:
    """Transfer of all parts in all directions that candidates need."""

    def __init__(
        self,
        parts: Sequence[SampledTransfer],
        bake: BakeSettings,
        rng: np.random.Generator,
        resolutions: Mapping[int, tuple[int, ...]] | None = None,
    ) -> None:
        self.resolutions = resolutions = resolutions or candidates(bake)
        self.parts = parts
        self.supersample = bake.supersample
        # given, it goes with a number of centres that is given
        self.bandwidth = bake.bandwidth
        self.n_rays, self.flops = 0, 0.0
        self.owner = np.repeat(np.arange(len(parts)), [part.n_functions for part in parts])
        self.held_out = ProbeDirections.held_out(HELD_OUT_RESOLUTION, rng)
        self.truth = self._sample(self.held_out)
        self.signal = self._sum((self.truth.astype(np.float64) ** 2).sum(axis=1))
        self.sampled: dict[int, tuple[ProbeDirections, F32]] = {}
        self.finest = max(RESOLUTIONS[-1], *(one[-1] for one in resolutions.values()))

    @property
    def n_functions(self) -> int:
        """Number of functions, of all parts."""
        return len(self.owner)

    @property
    def n_directions(self) -> int:
        """Number of directions at which these are held at once, the held-out ones included."""
        cubes = {self.finest}.union(*self.resolutions.values())
        return self.held_out.n + 6 * sum(one**2 for one in cubes)

    def work_with(self, n_centres: int) -> dict[str, float]:
        """Count what was done, and what trying a number of centres will come to it."""
        rays, flops = float(self.n_rays), self.flops
        for one in {self.finest, *self.resolutions[n_centres]} if self.n_functions else ():
            n_dirs = 6 * one**2
            flops += self._flops(n_centres, n_dirs)
            if one not in self.sampled:
                rays += self._rays(n_dirs, self.supersample**2)
        return {"trial_rays": rays, "trial_flops": flops}

    def _flops(self, n_centres: int, n_dirs: int) -> float:
        """Count the fit's system and its solution, and what is missed in directions held out."""
        solved = n_dirs + n_centres + self.held_out.n
        return 2.0 * n_centres * (n_dirs * n_centres + self.n_functions * solved)

    def _rays(self, n_dirs: int, n_samples: int) -> int:
        """Count the rays of shadows: half of the directions are above each vertex."""
        shadowed = (part.n_vertices for part in self.parts if part.accelerator is not None)
        return sum(n_verts * n_samples * n_dirs // 2 for n_verts in shadowed)

    def candidates_of(self, n_centres: int) -> list[Candidate]:
        """Fit at every resolution, and at the finest."""
        bandwidth = self.bandwidth or default_bandwidth(n_centres)
        basis = TrialBasis.of(icosphere(CENTRES.index(n_centres)), bandwidth)
        resolutions = self.resolutions[n_centres]
        errors = {
            one: self._error(basis, one) for one in dict.fromkeys((*resolutions, self.finest))
        }
        self._drop(n_centres)
        return [
            Candidate(n_centres, one, tuple(errors[one]), tuple(errors[self.finest]))
            for one in resolutions
        ]

    def _error(self, basis: TrialBasis, resolution: int) -> list[float]:
        if not self.owner.size:
            return [0.0] * len(self.parts)
        if resolution not in self.sampled:
            at = ProbeDirections.of_cube(resolution, self.supersample)
            self.sampled[resolution] = at, self._sample(at)
        coefficients = basis.fit(*self.sampled[resolution])
        self.flops += self._flops(len(coefficients), self.sampled[resolution][0].n)
        missed = self._sum(basis.missed(self.held_out, self.truth, coefficients))
        # where no light arrives nothing is lost of it
        shares = missed / np.where(self.signal > 0.0, self.signal, np.inf)
        return [float(share) for share in shares]

    def _drop(self, n_centres: int) -> None:
        """Free the samples that no larger number of centres asks for."""
        later = {self.finest}.union(
            *(fine for count, fine in self.resolutions.items() if count > n_centres)
        )
        self.sampled = {one: own for one, own in self.sampled.items() if one in later}

    def _sample(self, at: ProbeDirections) -> F32:
        # no part's samples are held twice but those of the last
        found = np.empty((self.n_functions, at.n), np.float32)
        self.n_rays += self._rays(at.n, at.rays.shape[0])
        start = 0
        for part in self.parts:
            found[start : start + part.n_functions] = part.sample(at)
            start += part.n_functions
        return found

    def _sum(self, energies: Float64[F64, " functions"]) -> Float64[F64, " parts"]:
        """Add up what functions have, part by part."""
        return np.bincount(self.owner, energies, len(self.parts)).astype(np.float64)
