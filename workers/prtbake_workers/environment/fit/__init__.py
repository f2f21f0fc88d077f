"""Scattered SRBFs fitted to an environment, section 5.3 of [Tsai2006]_."""

from prtbake_workers.environment.fit.scattered import (
    ScatteredFit,
    fit_environment,
    fit_scattered_srbf,
)
from prtbake_workers.environment.fit.target import fit_to_error

__all__ = ["ScatteredFit", "fit_environment", "fit_scattered_srbf", "fit_to_error"]
