"""A BRDF as a small neural network."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import above_horizon
from prtbake_workers.brdf.half_difference import half_frame

MAX_OUTPUT = 20.0
"""Largest output that is exponentiated: a BRDF of 5e8, beyond any measurement."""

CHUNK = 4096
"""Pairs of directions a pass: what passes between two layers then fits the cache."""


@dataclass(frozen=True, eq=False)
class Layer:
    """``x -> x weights + biases``."""

    weights: Float64[F64, "inputs outputs"]
    biases: Float64[F64, " outputs"]


@dataclass(frozen=True, eq=False)
class Nbrdf:
    """``exp(y) - 1`` with y the network's output, where negative 0 [Sztrajman2021]_.

    The inputs are the half vector and the difference vector with the half vector turned into the
    plane of x and z; rectified linear units stand between the layers.

    Attributes
    ----------
    layers
        From six inputs to three outputs.

    Notes
    -----
    Isotropic, but neither reciprocal nor mirror-symmetric: `symmetrised.Symmetrised` makes it so.

    References
    ----------
    .. [Sztrajman2021] A. Sztrajman, G. Rainer, T. Ritschel, T. Weyrich, "Neural BRDF Representation
       and Importance Sampling", 2021.
    """

    layers: tuple[Layer, ...]

    @property
    def n_channels(self) -> int:
        """Three: linear Rec.709."""
        return len(self.layers[-1].biases)

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr; 0 below the horizon."""
        above = above_horizon(wi, wo)
        frame = half_frame(wi, wo)
        signal = np.zeros((*above.shape, 6))
        signal[..., 0], signal[..., 2] = frame.sin_h, frame.cos_h
        signal[..., 3], signal[..., 4], signal[..., 5] = frame.along, frame.across, frame.cos_d
        signal = signal.reshape(-1, 6)
        value = np.zeros((len(signal), self.n_channels))
        for start in range(0, len(signal), CHUNK):
            rows = slice(start, start + CHUNK)
            value[rows] = self._output(signal[rows])
        value = value.reshape(*above.shape, -1)
        value[~above] = 0.0
        return value

    def _output(self, signal: Float64[F64, "n 6"]) -> Float64[F64, "n channels"]:
        for layer, _ in pairwise(self.layers):
            signal = signal @ layer.weights
            signal += layer.biases
            np.maximum(signal, 0.0, out=signal)
        last = self.layers[-1]
        output = signal @ last.weights + last.biases
        return np.expm1(np.clip(output, 0.0, MAX_OUTPUT))
