"""Scattered SRBFs fitted to an environment, section 5.3 of [Tsai2006]_."""

from prtbake_workers.environment.fit.scattered import (
    ScatteredFit,
    fit_environment,
    fit_scattered_srbf,
)

__all__ = ["ScatteredFit", "fit_environment", "fit_scattered_srbf"]
