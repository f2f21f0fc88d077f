"""What a unit of each stage's work takes on a machine: the rates of the cost model.

A stage takes ``factor x sum over units of (amount x seconds a unit)``; `stage_work` counts the
amounts, which no machine changes.  The rates that are shipped were fitted to jobs of one plain
2-core machine; `prtbake calibrate` puts this machine's in their place, and every job that ends
moves the factors of its stages a little.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from types import MappingProxyType
from typing import Any

from prtbake_storage.errors import SettingsError

Amounts = Mapping[str, float | int]
"""Unit -> how many of it a stage has to do."""

SHIPPED: Mapping[str, Mapping[str, float]] = MappingProxyType({
    "plan": MappingProxyType({
        "tasks": 1.1, "outlines": 0.7, "vertices": 1.9e-5, "glossy": 0.21, "oriented": 0.88,
        "solve_flops": 4.4e-11, "trial_flops": 6.3e-11, "trial_rays": 2.6e-7,
    }),
    "bake": MappingProxyType({
        "tasks": 1.0, "tables": 8e-10, "rays": 9.3e-8, "flops": 2.5e-11, "samples": 5.7e-9,
        "values": 1.6e-8,
    }),
    "scattering": MappingProxyType({
        "tasks": 0.87, "vertices": 8e-6, "entries": 5e-7,
    }),
    "bounces": MappingProxyType({
        "tasks": 0.85, "rays": 1.1e-6, "sparse_flops": 6e-10, "dense_flops": 2.7e-11,
        "values": 2e-8,
    }),
    "add_bounces": MappingProxyType({
        "tasks": 0.79, "values": 9e-8,
    }),
    "join": MappingProxyType({
        "tasks": 0.98, "values": 3.2e-9,
    }),
    "compress": MappingProxyType({
        "tasks": 0.83, "values": 1.3e-8, "product_flops": 3.6e-11, "solve_flops": 2e-11,
        "places": 6e-6, "moves": 5e-5,
    }),
    "quantise": MappingProxyType({
        "tasks": 0.91, "floats": 9.4e-8, "flops": 4.5e-11, "textures": 0.1,
    }),
    "fit_light": MappingProxyType({
        "tasks": 0.87, "entries": 1.4e-8, "flops": 1.4e-10, "texel_flops": 1.4e-10,
    }),
    "render": MappingProxyType({
        "tasks": 0.64, "pixels": 3.8e-7, "relit": 5.3e-8,
    }),
    "validate": MappingProxyType({
        "tasks": 1.4, "samples": 1.6e-7, "terms": 1.6e-8, "paths": 1.6e-6,
        "inside_paths": 1.6e-5, "cells": 1.5e-7, "cell_terms": 8.9e-9, "lights": 7.8e-9,
    }),
    "report": MappingProxyType({
        "tasks": 0.88,
    }),
})  # fmt: skip
"""Stage -> unit -> seconds, see `stage_work` for what the units are."""

BETWEEN_STAGES_S = 0.5
"""From the end of a stage's last task to the start of the next one's first: starting a process and
noticing that another has ended."""

WIDEST_FACTOR = 4.0
"""A stage's factor lies between this and its inverse: past jobs correct rates, calibration makes
them."""


@dataclass(frozen=True)
class Rates:
    """Seconds a unit of every stage, and what past jobs say they are off by.

    Attributes
    ----------
    seconds
        Stage -> unit -> seconds; every stage and unit of `SHIPPED`, and no other.
    factors
        Stage -> measured over predicted seconds of past jobs, 1 where there is none.
    calibration
        The job that measured the rates; None for those that are shipped.
    """

    seconds: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: SHIPPED)
    factors: Mapping[str, float] = field(default_factory=dict)
    calibration: str | None = None

    def base_seconds(self, stage: str, amounts: Amounts) -> float:
        """Predict a stage's seconds, without the factor that past jobs gave it."""
        own = self.seconds[stage]
        return sum((own[unit] * amount for unit, amount in amounts.items()), start=0.0)

    def stage_seconds(self, stage: str, amounts: Amounts) -> float:
        """Predict the seconds of a stage's tasks, added up."""
        return self.factors.get(stage, 1.0) * self.base_seconds(stage, amounts)

    def all_seconds(self, work: Mapping[str, Amounts]) -> dict[str, float]:
        """Predict the seconds of every stage that has work."""
        return {
            stage: self.stage_seconds(stage, amounts)
            for stage, amounts in work.items()
            if any(amounts.values())
        }

    def to_dict(self) -> dict[str, Any]:
        """Give the rates as JSON."""
        return {
            "seconds": {stage: dict(own) for stage, own in self.seconds.items()},
            "factors": dict(self.factors),
            "calibration": self.calibration,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any] | None) -> "Rates":
        """Read what a database or a context holds; None and {} stand for what is shipped.

        Units that a record does not know have their shipped rates, and those that are no more are
        left out: records outlive versions.

        Raises
        ------
        SettingsError
            A rate or factor is no positive finite number; it names it.
        """
        given = data or {}
        measured = given.get("seconds") or {}
        seconds = {
            stage: {
                unit: _positive(measured.get(stage, {}).get(unit, shipped), f"{stage}/{unit}")
                for unit, shipped in units.items()
            }
            for stage, units in SHIPPED.items()
        }
        factors = {
            stage: min(max(_positive(value, f"{stage}/factor"), 1.0 / WIDEST_FACTOR), WIDEST_FACTOR)
            for stage, value in (given.get("factors") or {}).items()
            if stage in SHIPPED
        }
        calibration = given.get("calibration")
        return cls(seconds, factors, None if calibration is None else str(calibration))


def _positive(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SettingsError(f"the rate {name} is no number but {value!r}", pointer=f"/{name}")
    if not isfinite(value) or value <= 0.0:
        raise SettingsError(f"the rate {name} is {value}: it must be positive", pointer=f"/{name}")
    return float(value)
