"""Registers that clusters will take, held against the renderer's before anything is fitted."""

import numpy as np

from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.superclusters import registers_of_clusters
from prtbake_workers.planning.presets import PartCompression


def planned_registers(
    compression: PartCompression, *, n_verts: int, n_terms: int, ranks_open: bool = False
) -> int:
    """Return the registers of four numbers that a cluster of a part takes at its full ranks.

    Parameters
    ----------
    compression
        Of the part.  Clusters whose vertices span less take fewer, which only the fit tells; those
        of ``adaptive`` classification may take more.
    n_verts, n_terms
        Of the part.
    ranks_open
        Whether ranks are still searched: then what any cluster takes at the least.
    """
    if compression.method == "cta":
        view, vectors = (1, 1) if ranks_open else (compression.ranks[0], compression.ranks[2])
    else:
        # to a signal every term is a view column of its own
        view, vectors = n_terms, 0 if ranks_open else compression.n_components
    ranks = np.array([[view, 1, min(vectors, n_verts)]], dtype=np.int32)
    return int(registers_of_clusters(ranks, with_mean=compression.method != "cta")[0])


def check_planned_registers(
    settings: CompressSettings,
    name: str,
    compression: PartCompression,
    *,
    n_verts: int,
    n_terms: int,
    settings_at: str = "/settings/compress",
) -> None:
    """Refuse a part whose clusters a renderer of so many registers could not draw one at a time.

    ``settings_at`` is the JSON pointer to the settings in the request.

    Raises
    ------
    SettingsError
        With the part and both numbers; nothing where no registers are given.
    """
    if settings.registers is None:
        return
    ranks_open = settings.max_error is not None or settings.max_bytes is not None
    need = planned_registers(compression, n_verts=n_verts, n_terms=n_terms, ranks_open=ranks_open)
    if need > settings.registers:
        raise SettingsError(
            f"registers is {settings.registers}: a cluster of {name} takes {need}; fewer "
            "components or lower ranks take fewer",
            pointer=f"{settings_at}/registers",
        )
