"""Rates of the cost model out of what stages took: robust, and no further from the prior than told.

Of each stage by itself, ``sum rho((log predicted - log measured) / NOISE) + (s / SHIFT)^2 +
sum_u ((t_u - s) / SPREAD)^2`` is least over the logarithms t_u of its rates over the prior's.  A
few jobs do not tell all units apart: what they leave open goes with the stage's common shift s, as
one machine is faster or slower than another in all that a stage does.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import isfinite

import numpy as np
from scipy.optimize import least_squares

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64
from prtbake_workers.planning.rates import Amounts, Rates

NOISE = 0.1
"""Relative: what a stage's seconds differ by from run to run on a machine with nothing else to do;
larger errors count by their size, not by its square."""

SHIFT, SPREAD = 1.5, 0.7
"""Logarithms: how far a machine may be from the prior in a whole stage, and its units from that."""

MOST_SHIFT = 4.0
"""Of a rate's logarithm: 55 times as fast or as slow."""


@dataclass(frozen=True)
class Observation:
    """What a stage of a job did, and the seconds of its tasks, added up."""

    stage: str
    amounts: Amounts
    seconds: float


def fit_rates(
    observations: Iterable[Observation],
    prior: Rates | None = None,
    *,
    shift: float = SHIFT,
    spread: float = SPREAD,
) -> dict[str, dict[str, float]]:
    """Fit the seconds a unit of every stage.

    Parameters
    ----------
    observations
        Of jobs that ran by themselves.  A stage without one keeps the prior's rates, and so do
        units that none of them has any of, but for the shift.
    prior
        None for the rates that are shipped.
    shift, spread
        In place of `SHIFT` and `SPREAD`.

    Raises
    ------
    SettingsError
        Seconds that are not positive and finite, or a stage or unit that the prior does not know.
    """
    known = (prior or Rates()).seconds
    by_stage: dict[str, list[Observation]] = {}
    for one in observations:
        _check(one, known)
        by_stage.setdefault(one.stage, []).append(one)
    return {
        stage: _fit_stage(by_stage[stage], units, shift, spread)
        if stage in by_stage
        else dict(units)
        for stage, units in known.items()
    }


def _fit_stage(
    observations: list[Observation], units: Mapping[str, float], shift: float, spread: float
) -> dict[str, float]:
    names = list(units)
    # seconds of every unit by the prior
    parts = np.array(
        [[units[name] * one.amounts.get(name, 0.0) for name in names] for one in observations]
    )
    measured = np.log([one.seconds for one in observations])

    def residuals(x: F64) -> F64:
        common, own = x[0], x[1:]
        predicted = np.log(np.maximum(parts @ np.exp(common + own), 1e-9))
        misfit = (predicted - measured) / NOISE
        # soft L1: sqrt(rho) of rho = 2 (sqrt(1 + z^2) - 1)
        robust = np.sign(misfit) * np.sqrt(2.0 * (np.sqrt(1.0 + misfit**2) - 1.0))
        return np.concatenate([robust, [common / shift], own / spread])

    bound = MOST_SHIFT / 2.0
    found = least_squares(
        residuals, np.zeros(1 + len(names)), bounds=(-bound, bound), method="trf", max_nfev=200
    )
    return {
        name: units[name] * float(np.exp(found.x[0] + own))
        for name, own in zip(names, found.x[1:], strict=True)
    }


def _check(one: Observation, known: Mapping[str, Mapping[str, float]]) -> None:
    if one.stage not in known:
        raise SettingsError(f"no rates are known of a stage {one.stage!r}", pointer="/stage")
    if not isfinite(one.seconds) or one.seconds <= 0.0:
        raise SettingsError(
            f"{one.stage} took {one.seconds} s: seconds must be positive", pointer="/seconds"
        )
    for unit, amount in one.amounts.items():
        if unit not in known[one.stage]:
            raise SettingsError(f"{one.stage} has no unit {unit!r}", pointer=f"/amounts/{unit}")
        if not isfinite(amount) or amount < 0.0:
            raise SettingsError(
                f"{one.stage} has {amount} {unit}: an amount is not negative",
                pointer=f"/amounts/{unit}",
            )
