"""Factorisations out of the tables that files hold of them."""

from collections.abc import Mapping
from typing import Any

from prtbake_workers.brdf.azimuthal_factorisation import AzimuthalFactorisation
from prtbake_workers.brdf.base import Brdf
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.harmonic_factorisation import HarmonicFactorisation
from prtbake_workers.brdf.oriented_factorisation import OrientedFactorisation


def factorisation_from_tables(
    tables: Mapping[str, Any], *, brdf: Brdf | None = None
) -> Factorisation:
    """Rebuild a factorisation from `Factorisation.tables`.

    Parities tell an anisotropic one, coefficients of the views one in harmonics.

    Raises
    ------
    CorruptArtefact
        An entry is missing; the message names it.
    """
    if "parities" in tables:
        return OrientedFactorisation.from_tables(tables, brdf=brdf)
    if "view_coefficients" in tables:
        return HarmonicFactorisation.from_tables(tables, brdf=brdf)
    return AzimuthalFactorisation.from_tables(tables, brdf=brdf)
