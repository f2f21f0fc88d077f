"""BRDFs of a scene's parts as sums of products, of as many terms as the settings say."""

from collections.abc import Sequence

from prtbake_storage.contract.settings import BakeSettings
from prtbake_workers.basis.hemisphere_basis import HemisphereBasis
from prtbake_workers.brdf.base import Brdf
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.factorise_harmonic import factorise_harmonic


def factorise_all(
    specs: Sequence[str], brdfs: Sequence[Brdf], bake: BakeSettings, *, view_dependent: bool
) -> tuple[Factorisation, ...]:
    """Factorise the BRDF of every part; parts may share one, and differ in the rest alone."""
    found: dict[str, Factorisation] = {}
    for spec, brdf in zip(specs, brdfs, strict=True):
        if spec not in found:
            found[spec] = _factorise(brdf, bake, view_dependent=view_dependent)
    return tuple(found[spec] for spec in specs)


def _factorise(brdf: Brdf, bake: BakeSettings, *, view_dependent: bool) -> Factorisation:
    """Factorise as the settings say; without view dependence by the best single product."""
    if not view_dependent:
        return factorise(brdf, n_terms=1)
    if bake.view_order is not None:
        return factorise_harmonic(brdf, bake.view_order, HemisphereBasis(bake.view_order).kept)
    energy_lost = bake.term_energy_lost if bake.n_terms is None else None
    return factorise(brdf, n_terms=bake.n_terms, energy_lost=energy_lost)
