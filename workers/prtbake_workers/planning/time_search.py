"""The search for the best settings that a time allows: its decisions, as pure functions."""

from collections.abc import Mapping
from dataclasses import dataclass

MARGIN = 1.3
"""Of predicted seconds: an attempt that runs out of time is lost, one not made is only missed."""

LEAST_SAMPLES = 8
"""Light samples a pixel and pass that a validation is left with, however short the time."""


@dataclass(frozen=True)
class Measured:
    """An attempt that was made: what it was predicted to take, and what it took by the clock.

    ``making`` leaves out the light's fit, which grows by other numbers.
    """

    making_predicted: float
    making: float
    fit_predicted: float
    fit: float


@dataclass(frozen=True)
class Step:
    """Predicted seconds of a step: making an asset, fitting its light, and what comes after."""

    making: float
    fit: float
    rest: float


def predicted_seconds(step: Step, told: Measured) -> tuple[float, float]:
    """Predict by what another attempt took: making and fit, and then what comes after."""
    making = off_by(told.making, told.making_predicted)
    fit = off_by(told.fit, told.fit_predicted)
    return MARGIN * (making * step.making + fit * step.fit), kept_for(step.rest, making)


def kept_for(rest: float, off: float = 1.0) -> float:
    """Say how many seconds are kept for what comes after a search, at the end of its time.

    ``rest`` are those predicted, ``off`` is what predictions were measured to be off by: a slow
    machine is slow there too, a quick one is not counted on.
    """
    return MARGIN * max(off, 1.0) * rest


def off_by(measured: float, predicted: float) -> float:
    """Give the factor that predicted seconds are off by; 1 where nothing tells."""
    return measured / predicted if measured > 0.0 and predicted > 0.0 else 1.0


def choose_step(
    steps: Mapping[int, Step], last: int, told: Measured, left: float
) -> tuple[int | None, float | None]:
    """Choose the highest step above the last whose predicted seconds fit into those that are left.

    Returns
    -------
    int or None, float or None
        The step, None where none fits; and the least that any of them would take, None where
        there is none above.
    """
    needed = {step: sum(predicted_seconds(own, told)) for step, own in steps.items() if step > last}
    fitting = [step for step, seconds in needed.items() if seconds <= left]
    return max(fitting, default=None), min(needed.values(), default=None)


def samples_for(samples: int, seconds: float, left: float) -> int:
    """Lower the samples of a validation to what can be drawn in the seconds that are left."""
    if seconds <= left:
        return samples
    return min(samples, max(LEAST_SAMPLES, int(samples * max(left, 0.0) / seconds)))
