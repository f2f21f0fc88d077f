"""Transfer itself out of a part's factors, for whoever wants to measure its error."""

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.asset import Part

F32 = NDArray[np.float32]


def reconstruct(part: Part, verts: slice) -> F32:
    """Return the whitened transfer (verts, channels * terms, coeffs) of some vertices of a part.

    [Tsai2006]_ eq. (18) for tensor factors, mean plus weighted components otherwise.
    """
    labels, weights = part.labels[verts], part.weights[verts]
    n_terms, n_view = part.view_basis.shape
    if part.light_bases is not None and part.dual_bases is not None:
        n_coeffs, n_light = part.light_bases.shape[1:]
        transfer = np.zeros((len(labels), part.n_channels * n_terms, n_coeffs), np.float32)
        for cluster in np.unique(labels):
            members = np.flatnonzero(labels == cluster)
            core = (weights[members] @ part.dual_bases[cluster]).reshape(-1, n_view, n_light)
            terms = (part.view_basis @ core) @ part.light_bases[cluster].T
            transfer[members] = terms.reshape(len(members), -1, n_coeffs)
        return transfer
    if part.means is None or part.components is None:
        raise ValueError(f"part {part.name!r} holds no factors")
    signal = part.means[labels]
    for cluster in np.unique(labels):
        members = np.flatnonzero(labels == cluster)
        signal[members] += weights[members] @ part.components[cluster]
    columns = signal.reshape(len(signal) * part.n_channels, n_view, -1)
    terms = part.view_basis @ columns
    return np.asarray(terms.reshape(len(signal), part.n_channels * n_terms, -1))
