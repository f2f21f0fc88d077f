"""What one step more or less on the ladder of qualities would cost the same scene."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import get_args

import numpy as np

from prtbake_storage.contract.settings import AssetSettings, BakeSettings, Quality
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.planning.presets import StageSettings, resolve_stages
from prtbake_workers.planning.step_errors import Resolution, line_factors

CHECKS = ("render", "validate")
"""Stages that show an asset and make nothing of it: their seconds are not its price."""


@dataclass(frozen=True)
class LadderStep:
    """A quality and what it is predicted to cost: work in seconds, bytes of ``asset.h5``."""

    quality: Quality
    seconds: float
    asset_bytes: int
    terms: tuple[int, ...]
    """Of each part."""
    error_factors: dict[str, float] = field(default_factory=dict)
    """Of the lines of an error budget, by what decides them: see `line_factors`."""


@dataclass(frozen=True)
class StepCost:
    """What planning says of a scene at some settings: seconds by stage, bytes of ``asset.h5``."""

    seconds: Mapping[str, float]
    asset_bytes: int
    resolution: Resolution


def legal_steps(overrides: AssetSettings) -> list[tuple[Quality, StageSettings]]:
    """Resolve the ladder with a request's overrides, lowest first; what they forbid is left out.

    Raises
    ------
    SettingsError
        They are legal at no step.
    """
    found: list[tuple[Quality, StageSettings]] = []
    refused: SettingsError | None = None
    for quality in get_args(Quality):
        try:
            found.append((quality, resolve_stages(quality, overrides)))
        except SettingsError as error:
            refused = error
    if not found and refused is not None:
        raise refused
    return found


def neighbours(quality: Quality, overrides: AssetSettings) -> dict[Quality, StageSettings]:
    """Resolve the qualities beside one, with the same overrides; what they forbid is left out."""
    ladder = list(get_args(Quality))
    at = ladder.index(quality)
    found: dict[Quality, StageSettings] = {}
    for other in (*ladder[max(0, at - 1) : at], *ladder[at + 1 : at + 2]):
        try:
            found[other] = resolve_stages(other, overrides)
        except SettingsError:
            continue
    return found


def terms_at(
    own: int, singular_values: Float64[F64, " values"], bake: BakeSettings, *, view_dependent: bool
) -> int:
    """Predict the terms of a part of ``own`` terms at other settings, from its BRDF's spectrum.

    A pair of terms that belong together may be counted as one.
    """
    if not view_dependent or bake.view_order is not None:
        return own
    if bake.n_terms is not None:
        return min(bake.n_terms, len(singular_values))
    energy = singular_values**2
    left = energy.sum() - np.cumsum(energy)
    return int(np.argmax(left <= (bake.term_energy_lost or 0.0) * energy.sum())) + 1


def ladder_steps(
    steps: Mapping[Quality, StageSettings],
    own_terms: Sequence[int],
    spectra: Sequence[Float64[F64, " _"]],
    cost_of: Callable[[list[int], StageSettings, Quality], StepCost],
    *,
    own: Resolution,
    view_dependent: bool,
) -> tuple[LadderStep, ...]:
    """Predict the same scene at other qualities.

    Parameters
    ----------
    steps
        Their settings; those that leave numbers to a trial are not predicted.
    own_terms, spectra
        Of each part: its terms as planned, and the singular values of its BRDF.
    cost_of
        From terms, settings and quality; where it raises a `SettingsError` that step cannot be run,
        and is left out.
    own
        As planned.
    """
    found = []
    for quality, settings in steps.items():
        if settings.bake.open_numbers:
            continue
        terms = [
            terms_at(planned, values, settings.bake, view_dependent=view_dependent)
            for planned, values in zip(own_terms, spectra, strict=True)
        ]
        try:
            cost = cost_of(terms, settings, quality)
        except SettingsError:
            continue
        found.append(
            LadderStep(
                quality,
                making_seconds(cost.seconds),
                cost.asset_bytes,
                tuple(terms),
                line_factors(own, cost.resolution),
            )
        )
    return tuple(found)


def making_seconds(seconds: Mapping[str, float]) -> float:
    """Add up what an asset's stages take, without those that only show it."""
    return sum((value for stage, value in seconds.items() if stage not in CHECKS), start=0.0)
