"""What the path tracer has to know of each part."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.brdf.base import Brdf
from prtbake_workers.transport.dipole_sampling import DipoleSampler
from prtbake_workers.transport.proposal import Proposal, fit_proposal


@dataclass(frozen=True)
class PathMaterial:
    """How one part reflects.

    Attributes
    ----------
    brdf
        In the frame of the vertices.
    texture
        What multiplies the BRDF at triangles and barycentrics, (points, 3); None for 1.
    two_sided
        Whether the back reflects as the front does.
    scattering
        Of a part that scatters light inside; the BRDF is then Lambert with albedo 1, and the
        texture tints what leaves.
    """

    brdf: Brdf
    texture: Callable[[Int64[I64, " n"], Float64[F64, "n 3"]], Float64[F64, "n 3"]] | None = None
    two_sided: bool = False
    scattering: DipoleSampler | None = None

    @cached_property
    def proposal(self) -> Proposal:
        """The density that paths go on with, fitted once."""
        return fit_proposal(self.brdf)
