"""What bakes of one scene are predicted to leave, to weigh and to take, from a trial of it.

The trial measures projections of a few vertices' transport by pairs of centres and cube maps; a
line between two resolutions is a power of them.  The BRDFs' spectra tell what terms leave, and
sizes and seconds are counted.  A bake that was made corrects all four by what it says of itself.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, sqrt
from typing import Any

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.planning.bounce_rays import NOISE_SHARE
from prtbake_workers.planning.cost import TILE_SECONDS, bake_seconds_per_vertex
from prtbake_workers.planning.file_bytes import (
    CENTRE_BYTES,
    KnownBytes,
    PartNumbers,
    transfer_bytes,
)
from prtbake_workers.planning.presets import PlannedBake
from prtbake_workers.planning.stage_work import bake_work, total
from prtbake_workers.transport.ray_pilot import FALL, FEWEST

Work = Mapping[str, Mapping[str, float]]

MOST_RAYS = 1024
"""A vertex, that look for bounced light where an error decides how many."""

RESOLUTION_WEIGHT = 24
"""N of the cube map at which its directions weigh as much as what is stored, see `BakeModel`."""

MOST_OFF = 10.0
"""Factor that a trial is taken to be off by, at most."""

FIXED_UNITS = ("tasks", "rays", "vertices", "entries")
"""Of stages beside the tiles: amounts that do not grow with terms and coefficients."""

TINY = 1e-30

LINES = ("projection", "terms", "rest")
"""Of a part's error, as searches tell them apart."""


@dataclass(frozen=True)
class Numbers:
    """What a budget chooses: terms by the share that they lose or by number, if at all."""

    n_centres: int
    cube_resolution: int
    term_energy_lost: float | None
    bounce_tolerance: float
    n_terms: int | None = None


@dataclass(frozen=True)
class Told:
    """A bake that was made, by its own account.

    Attributes
    ----------
    projection, terms, rest
        Squared-error ratios of each part: what directions and functions leave, what terms leave,
        and the sum of all else.
    size
        Bytes of ``transfer.h5``.
    seconds
        By the clock; None where nobody asked.
    """

    numbers: Numbers
    projection: tuple[float, ...]
    terms: tuple[float, ...]
    rest: tuple[float, ...]
    size: int
    seconds: float | None = None

    @property
    def errors(self) -> Float64[F64, " parts"]:
        """Squared-error ratio of each part."""
        return np.add(np.add(self.projection, self.terms), self.rest)

    @property
    def error(self) -> float:
        """Relative L2 error of the part that it is largest of."""
        return sqrt(float(self.errors.max()))

    def worst(self) -> tuple[int, str]:
        """Give the worst part, and which of its lines is the largest."""
        part = int(self.errors.argmax())
        return part, max(LINES, key=lambda line: float(getattr(self, line)[part]))


@dataclass(frozen=True)
class Cut:
    """What ended a trial before its centres were enough.

    Attributes
    ----------
    field
        Of the budget: ``max_bytes`` or ``max_seconds``.
    n_centres
        The next that would have been tried.
    least
        Of that field, that lets them be tried.
    """

    field: str
    n_centres: int
    least: int


@dataclass(frozen=True, eq=False)
class Foreseen:
    """Predictions for all rows of a model: ``errors`` are squared, of the worst part."""

    projection: Float64[F64, "rows parts"]
    terms: Float64[F64, "rows parts"]
    rest: Float64[F64, " parts"]
    sizes: Float64[F64, " rows"]
    seconds: Float64[F64, " rows"]

    @property
    def errors(self) -> Float64[F64, " rows"]:
        """Squared-error ratio of the worst part of each row."""
        return np.asarray((self.projection + self.terms + self.rest).max(axis=1))

    def worst(self, row: int) -> tuple[int, str]:
        """Give the worst part of a row, and which of its lines is the largest."""
        lines = dict(zip(LINES, (self.projection[row], self.terms[row], self.rest), strict=True))
        part = int(sum(lines.values()).argmax())
        return part, max(LINES, key=lambda line: float(lines[line][part]))


class BakeModel:
    """All bakes that a trial lets choose among: a row for each choice of numbers.

    Parameters
    ----------
    trial
        As `prtbake_workers.jobs.bake_trial.run` gives it.
    seconds_of
        From the work of a bake's stages to seconds by the clock; None where no time is asked for.

    Attributes
    ----------
    cost
        Of each row, in no unit: what is stored, and what is multiplied for it.  The cheapest of
        those that serve is taken.
    cut
        What ended the trial, where that was not that its centres were enough, or all.
    """

    def __init__(
        self, trial: Mapping[str, Any], seconds_of: Callable[[Work], float] | None = None
    ) -> None:
        self._trial = trial
        self._parts: list[dict[str, Any]] = trial["parts"]
        self._bake = PlannedBake.model_validate(trial["bake"])
        self.cut = None if trial["cut"] is None else Cut(**trial["cut"])
        options: list[dict[str, Any]] = trial["options"]
        curves = _curves(trial["candidates"])
        self.choices = [
            (n_centres, resolution, place)
            for n_centres, own in curves.items()
            for resolution in own
            for place in range(len(options))
        ]
        self._row_of = {
            (
                n_centres,
                resolution,
                options[place]["term_energy_lost"],
                options[place]["n_terms"],
            ): row
            for row, (n_centres, resolution, place) in enumerate(self.choices)
        }
        self._options = options
        self._projection = np.array([curves[count][fine] for count, fine, _ in self.choices])
        self._terms = np.array([options[place]["lost"] for *_, place in self.choices])
        sizes = {
            (count, place): self._size(count, options[place]["terms"])
            for count, _, place in self.choices
        }
        self._sizes = np.array([sizes[count, place] for count, _, place in self.choices], float)
        stored = np.array([self._values(count, place) for count, _, place in self.choices])
        fine = np.array([resolution for _, resolution, _ in self.choices], float)
        self.cost: Float64[F64, " rows"] = stored * (fine**2 + RESOLUTION_WEIGHT**2)
        self._seconds = np.zeros(len(self.choices))
        if seconds_of is not None:
            self._seconds[:] = [seconds_of(self.work(row)) for row in range(len(self.choices))]

    @property
    def names(self) -> list[str]:
        """Give the names of the parts."""
        return [part["name"] for part in self._parts]

    def numbers(self, row: int, tolerance: float) -> Numbers:
        """Give the numbers of a row."""
        n_centres, resolution, place = self.choices[row]
        return Numbers(
            n_centres,
            resolution,
            self._options[place]["term_energy_lost"],
            float(tolerance),
            self._options[place]["n_terms"],
        )

    def row(self, numbers: Numbers) -> int:
        """Find the row of some numbers."""
        return self._row_of[
            numbers.n_centres, numbers.cube_resolution, numbers.term_energy_lost, numbers.n_terms
        ]

    def foreseen(self, told: Told | None, tolerance: float) -> Foreseen:
        """Predict all rows where bounces are traced to a tolerance, as a bake before corrects it.

        Before there is one, or where nothing bounds what they left, bounces are taken to leave what
        they may: half of the tolerance to their rays, and as much to those that are left out.
        """
        may = self._trial["left_out"] + (tolerance if self._trial["bounced"] else 0.0)
        assumed = np.full(len(self._parts), may, np.float64)
        if told is None:
            return Foreseen(self._projection, self._terms, assumed, self._sizes, self._seconds)
        at = self.row(told.numbers)
        before = told.numbers.bounce_tolerance
        scale = tolerance / before if before > 0.0 else 1.0
        # starting processes and multiplying may be off by different factors: none is counted on
        seconds = max(1.0, float(_off_by(told.seconds or 0.0, float(self._seconds[at]))))
        return Foreseen(
            _corrected(self._projection, np.array(told.projection), at),
            _corrected(self._terms, np.array(told.terms), at),
            np.where(np.isfinite(told.rest), np.multiply(told.rest, scale), assumed),
            self._sizes * (told.size / self._sizes[at]),
            self._seconds * seconds,
        )

    def rays(self, tolerance: float) -> int:
        """Count the rays that look for bounced light, by what one ray a vertex would miss."""
        worst = max(self._trial["variances"], default=0.0)
        if worst <= 0.0 or tolerance <= 0.0:
            return FEWEST
        needed = (worst / (NOISE_SHARE * tolerance)) ** (1.0 / FALL)
        return int(min(MOST_RAYS, max(FEWEST, ceil(needed))))

    def _values(self, n_centres: int, place: int) -> float:
        terms = self._options[place]["terms"]
        rows = sum(own["n_verts"] * k for own, k in zip(self._parts, terms, strict=True))
        return float(self._trial["n_channels"] * rows * n_centres)

    def _size(self, n_centres: int, terms: Sequence[int]) -> int:
        return sized(self._trial, n_centres, terms)

    def work(self, row: int) -> dict[str, dict[str, float]]:
        """Count the work of a row's bake: tiles as they are, other stages by what they store."""
        count, resolution, place = self.choices[row]
        own = self._trial["own"]
        terms = self._options[place]["terms"]
        bake = self._bake.model_copy(update={"n_centres": count, "cube_resolution": resolution})
        before = sum(part["n_verts"] * k for part, k in zip(self._parts, own["terms"], strict=True))
        more = self._values(count, place) / (self._trial["n_channels"] * before * own["n_centres"])
        found = {
            stage: {
                unit: amount * (1.0 if unit in FIXED_UNITS else more)
                for unit, amount in amounts.items()
            }
            for stage, amounts in self._trial["work"].items()
        }
        n_dirs = 6 * resolution**2
        found["plan"] = self._trial["work"]["plan"] | {
            "solve_flops": 4.0 * n_dirs * count**2 + 10.0 * count**3
        }
        found["bake"] = total(
            bake_work(
                bake,
                n_verts=part["n_verts"],
                n_terms=k,
                shadows=part["shadows"],
                n_tiles=_tiles(bake, part, k),
            )
            for part, k in zip(self._parts, terms, strict=True)
        )
        return found


def sized(trial: Mapping[str, Any], n_centres: int, terms: Sequence[int]) -> int:
    """Predict ``transfer.h5`` of so many centres, and terms of each part."""
    numbers = [
        PartNumbers(
            n_verts=part["n_verts"],
            n_rows=trial["n_channels"] * n_terms,
            n_channels=trial["n_channels"],
            even=part["even"],
            n_coeffs=n_centres,
            factor_floats=0,
            view_columns=0,
            scattered=part["scattered"],
        )
        for part, n_terms in zip(trial["parts"], terms, strict=True)
    ]
    fixed: int = trial["fixed_bytes"]
    tables = sum(part["term_bytes"] * k for part, k in zip(trial["parts"], terms, strict=True))
    grown: int = round(tables + CENTRE_BYTES * n_centres)
    return fixed + grown + transfer_bytes(KnownBytes(0, {}, ()), numbers)


def effects_left_out(effects: Sequence[Mapping[str, Any]]) -> float:
    """Sum what effects are predicted to cost that planning left out, and no request did.

    ``effects`` are decisions as JSON; light without bounces has no colours to bleed either.
    """
    taken = {one["effect"]: one["taken"] for one in effects}
    counted = ["self_shadowing", "interreflection", "subsurface_scattering"]
    if taken.get("interreflection"):
        counted.append("colour_bleeding")
    return float(
        sum(
            one["predicted_error_otherwise"] or 0.0
            for one in effects
            if one["effect"] in counted and not one["taken"] and not one["forced"]
        )
    )


def _tiles(bake: PlannedBake, part: Mapping[str, Any], n_terms: int) -> int:
    n_verts: int = part["n_verts"]
    seconds = bake_seconds_per_vertex(bake, n_terms=n_terms, shadows=part["shadows"])
    return max(1, ceil(n_verts * seconds / TILE_SECONDS))


def _curves(candidates: Sequence[Mapping[str, Any]]) -> dict[int, dict[int, F64]]:
    """Lay power laws between tried resolutions: centres -> resolution -> error of each part.

    Between those that were tried lie even ones: others have no `MirroredProduct`, and take longer
    than the next.
    """
    tried: dict[int, dict[int, F64]] = {}
    for one in candidates:
        own = tried.setdefault(one["n_centres"], {})
        own[one["cube_resolution"]] = np.array(one["errors"], np.float64)
    found: dict[int, dict[int, F64]] = {}
    for n_centres, own in tried.items():
        at = np.log(list(own))
        values = np.log(np.maximum(list(own.values()), TINY))
        fine = np.array([n for n in range(min(own), max(own) + 1) if n in own or n % 2 == 0])
        between = np.stack([np.interp(np.log(fine), at, line) for line in values.T], axis=1)
        errors = np.where(between > np.log(2.0 * TINY), np.exp(between), 0.0)
        found[n_centres] = dict(zip(fine.tolist(), errors, strict=True))
    return found


def _corrected(
    predicted: Float64[F64, "rows parts"], measured: Float64[F64, " parts"], at: int
) -> Float64[F64, "rows parts"]:
    """Correct predictions of all rows by what was measured of one of them.

    Nothing that was predicted is off by no factor: there, all are taken to leave what was measured,
    at least.
    """
    unforeseen = np.where(predicted[at] > 0.0, 0.0, measured)
    return np.asarray(np.maximum(predicted * _off_by(measured, predicted[at]), unforeseen))


def _off_by(measured: Any, predicted: Any) -> Any:
    """Give the factor that a prediction was off by; 1 where it was of nothing."""
    ratio = np.divide(
        measured, predicted, out=np.ones(np.shape(predicted)), where=np.asarray(predicted) > 0.0
    )
    return np.where(np.asarray(measured) > 0.0, np.clip(ratio, 1.0 / MOST_OFF, MOST_OFF), 1.0)
