"""What a trial of a part's compression does and holds, by the sizes of what it looks at.

All that is done beside rays is counted in `trial_flops`: the unit of float64 products, as the other
trials of planning count them.
"""

from dataclasses import dataclass

from prtbake_storage.contract.settings import CompressSettings
from prtbake_workers.planning.packed_factors import ITERATIONS
from prtbake_workers.planning.presets import PartCompression
from prtbake_workers.planning.sampled_transfer import VALUES_PER_BLOCK
from prtbake_workers.planning.search_work import searched_work

PLACE_BYTES = 140
"""Of a vertex of the whole part while clusters are drawn: 131 measured."""

COMPRESSED_BYTES = 26
"""Of a coefficient while it is compressed, itself and its copy included: 18 to 25 measured of
tensors of a hundred vertices or more, and 12 to 26 of signals, most where all are one cluster."""

SAMPLE_FLOPS, PROJECTED_FLOPS = 100.0, 0.1
"""A vertex in a direction, and each of its terms there; a float32 product that projects it."""

VALUE_FLOPS, TEXEL_FLOPS = 650.0, 2200.0
"""Of a coefficient of what is compressed, beside products: reading, rounding and packing; of a
texel's number, of which lookups are tried too.  Fitted to trials of 60 jobs, which they predict
within two for nine of ten."""


@dataclass(frozen=True)
class TrialSize:
    """What is looked at of a part.

    Attributes
    ----------
    n_verts, n_terms, n_coeffs, n_channels, n_dirs
        Vertices that are drawn, and what they are sampled in and compressed as.
    whole_verts
        Vertices of the part.
    compression
        Of what is drawn.
    rays
        Whether anything may block light.
    texels
        Numbers of the view side.
    """

    n_verts: int
    n_terms: int
    n_coeffs: int
    n_channels: int
    n_dirs: int
    whole_verts: int
    compression: PartCompression
    rays: bool
    texels: int = 0

    @property
    def work(self) -> dict[str, float]:
        """Amounts as `plan_work` names them."""
        if self.n_verts == 0:
            return {}
        samples = float(self.n_verts * self.n_dirs)
        values = float(self.n_verts * self.n_channels * self.n_terms * self.n_coeffs)
        compressed = searched_work(
            self.compression,
            CompressSettings(max_iterations=ITERATIONS, threads=1),
            n_verts=self.n_verts,
            n_terms=self.n_terms,
            n_coeffs=self.n_coeffs,
            n_channels=self.n_channels,
        )
        products = 2.0 * samples * self.n_terms * (self.n_coeffs + self.n_terms)
        return {
            # half of the directions are above a surface
            "trial_rays": samples / 2.0 if self.rays else 0.0,
            "trial_flops": SAMPLE_FLOPS * samples * (1 + self.n_terms)
            + PROJECTED_FLOPS * products
            + compressed["product_flops"]
            + VALUE_FLOPS * values
            + TEXEL_FLOPS * self.texels,
        }

    @property
    def memory_bytes(self) -> int:
        """Predict the most that is held at once, without interpreter, scene and basis."""
        samples = self.n_verts * self.n_dirs
        block = min(samples, VALUES_PER_BLOCK // self.n_terms)
        # samples of all terms; of a block local directions, visibility and terms
        sampling = 4 * samples * self.n_terms + 4 * block * (5 + self.n_terms)
        values = self.n_verts * self.n_channels * self.n_terms * self.n_coeffs
        return max(PLACE_BYTES * self.whole_verts, sampling, COMPRESSED_BYTES * values)


def directions_work(*, n_dirs: int, n_coeffs: int) -> dict[str, float]:
    """Count what makes a basis orthonormal and projects samples on it."""
    return {
        "trial_rays": 0.0,
        "trial_flops": 0.0,
        "solve_flops": 4.0 * n_dirs * n_coeffs**2 + 10.0 * n_coeffs**3,
    }


def directions_bytes(*, n_dirs: int, n_coeffs: int) -> int:
    """Predict what making that holds: four float64 matrices; afterwards an eighth is left."""
    return 32 * n_dirs * n_coeffs
