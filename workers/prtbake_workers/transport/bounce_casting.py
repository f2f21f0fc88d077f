"""Casts the rays of bounces: of whole parts, and of some vertices to tell what few rays cost."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bounce_error import Gather
from prtbake_workers.transport.part_scattering import PartScattering
from prtbake_workers.transport.ray_pilot import pilot_rays
from prtbake_workers.transport.separable_bounce import BounceGather
from prtbake_workers.transport.smoothing import Smoothing
from prtbake_workers.transport.surface import OpaqueSurface


@dataclass(frozen=True)
class BounceCasting:
    """All that rays of bounces have in common; ``counters`` count those of whole parts."""

    surface: OpaqueSurface
    factorisations: Sequence[Factorisation]
    albedo: Albedo
    n_channels: int
    seed: int
    counters: Counter[str] = field(default_factory=Counter)

    def parts(self, n_rays: Sequence[int]) -> list[BounceGather]:
        """Cast those of every vertex of every part; of no part where no number is given."""
        found = []
        for part, own in enumerate(n_rays):
            start, stop = self.surface.scene.part_ranges[part]
            gather = self._to(part, np.arange(start, stop), own, self.seed)
            self.counters.update(gather.counters())
            found.append(gather)
        return found

    def at_some(
        self,
        sent: Sequence[Float32[F32, "_ channels _ coeffs"]],
        media: Sequence[PartScattering | None],
        n_rays: Sequence[int],
    ) -> Gather:
        """Bounce what is sent to some vertices; a medium gives back its albedo's share."""

        def gather(part: int, vertices: Int64[I64, " verts"], seed: int) -> F32:
            found = self._to(part, vertices, n_rays[part], seed).apply(sent)
            if (medium := media[part]) is not None:
                found *= medium.albedo(self.n_channels).astype(np.float32)[:, None, None]
            return found

        return gather

    def pilot(
        self,
        sent: Sequence[Float32[F32, "_ channels _ coeffs"]],
        n_rays: Sequence[int],
        smoothings: Sequence[Smoothing | None],
        allowed: Float64[F64, " parts"],
    ) -> list[int]:
        """Choose the rays of a vertex of each part, at most ``n_rays``.

        ``allowed`` are the squared errors of whole parts, area-weighted.
        """
        found = list(n_rays)
        for part, smoothing in enumerate(smoothings):
            start, stop = self.surface.scene.part_ranges[part]
            areas = np.maximum(self.surface.scene.areas[start:stop], 0.0)
            if smoothing is None or not areas.any():
                continue
            found[part] = pilot_rays(
                partial(self._received, sent, part),
                smoothing,
                areas,
                most=n_rays[part],
                allowed=float(allowed[part]) / float(areas.sum()),
                seed=self.seed,
            )
        return found

    def _received(
        self, sent: Sequence[F32], part: int, vertices: Int64[I64, " verts"], rays: int, seed: int
    ) -> F32:
        return self._to(part, self.surface.scene.part_ranges[part][0] + vertices, rays, seed).apply(
            sent
        )

    def _to(
        self, part: int, vertices: Int64[I64, " verts"], n_rays: int, seed: int
    ) -> BounceGather:
        return BounceGather(
            self.surface,
            part,
            vertices,
            factorisations=self.factorisations,
            albedo=self.albedo,
            n_channels=self.n_channels,
            n_rays=n_rays,
            seed=seed,
        )
