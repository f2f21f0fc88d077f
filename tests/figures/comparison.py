"""Errors of exit radiance by each projection, summed over points, views and lights.

The error of a projection at a point is an operator D too, a row a view and a column a coefficient
of the light.  Its squares under the weights of the views, ``D^T W D``, summed over the points by
area, give the error under any light l as ``l^T G l`` and the mean over all lights of unit power as
``trace G / 25``.
"""

from dataclasses import dataclass, field

import numpy as np

from figures.exit_radiance import (
    brdf_matrix,
    hemisphere_rule,
    incident_light,
    reflection_kernel,
    transfer,
)
from figures.projections import COMPARED, exit_functions, transfer_matrices
from prtbake_workers.basis.sh import HemisphereBasis
from prtbake_workers.transport.directions import cube_directions

LIGHT_ORDER = 5
HIGHEST = max(max(p.exitant, p.incident) for p in COMPARED)
SILHOUETTE = 0.25
"""Cosine below which a view counts as one of the silhouette: within 14.5 degrees of grazing."""

FITTED = "16 functions fitted to the reference"
COARSER = "the reference with half its directions"


@dataclass(frozen=True)
class Sizes:
    """Resolution of both ways: rings and azimuths about a normal, texels along a cube's edge.

    C-T m 0.3 sets the azimuths: at grazing angles its lobe is narrower than its m says.
    """

    reference: tuple[int, int] = (40, 256)
    coarser: tuple[int, int] = (28, 180)
    brdf: tuple[int, int] = (40, 512)
    views: tuple[int, int] = (8, 32)
    cube: int = 32
    supersample: int = 2
    block: int = 16


@dataclass
class Tally:
    """Squares summed over points, for each measure of the views.

    Attributes
    ----------
    gram
        Measure to G, (light, light), weighted by area.
    of_point
        Trace of each point's own G under the cosine measure.
    """

    gram: dict = field(default_factory=dict)
    of_point: list = field(default_factory=list)

    def add(self, operators, areas, measures):
        """Add operators (points, views, light)."""
        for name, weights in measures.items():
            rows = (np.sqrt(weights)[:, None] * operators).astype(np.float64)
            own = np.einsum("pvj,pvj->p", rows, rows)
            rows *= np.sqrt(areas)[:, None, None]
            rows = rows.reshape(-1, rows.shape[-1])
            self.gram[name] = self.gram.get(name, 0.0) + rows.T @ rows
            if name == "cosine":
                self.of_point.append(own)

    def relative(self, reference, measure, light=None):
        """Give the relative RMS error under a light, (light, channels), or over all lights."""
        light = np.eye(len(self.gram[measure])) if light is None else light
        squares = [np.sum(light * (t.gram[measure] @ light)) for t in (self, reference)]
        return float(np.sqrt(squares[0] / squares[1]))

    def silhouette_share(self):
        """Give the share of the squares over the hemisphere that lies at silhouettes."""
        return float(np.trace(self.gram["silhouette"]) / np.trace(self.gram["solid angle"]))

    def better_share(self, other, reference, areas):
        """Give the share of the lit area where this error is below the other one."""
        own, others, signal = (np.concatenate(t.of_point) for t in (self, other, reference))
        return float(areas @ ((own < others) & (signal > 0.0)) / (areas @ (signal > 0.0)))


def view_measures(views, weights):
    """Weight views as pixels do, by solid angle as least squares does, and at silhouettes alone.

    Of a distant camera that may stand anywhere, a piece of surface fills pixels in proportion to
    the cosine.
    """
    cosine = views[:, 2]
    return {
        "cosine": weights * cosine,
        "solid angle": weights,
        "silhouette": weights * (cosine < SILHOUETTE),
    }


def compare(points, accelerator, brdfs, sizes):
    """Measure every projection for every BRDF.

    Parameters
    ----------
    points
        Where; weighted by their areas.
    accelerator
        What casts shadows.
    brdfs
        Name to isotropic BRDF; the first channel counts.
    sizes
        Resolutions.

    Returns
    -------
    dict
        Name of the BRDF to a dictionary of `Tally`: by name of the projection, `FITTED`,
        `COARSER`, and ``reference`` with the squares of the reference itself.
    """
    views, weights = hemisphere_rule(*sizes.views, breaks=(0.0, SILHOUETTE, 1.0))
    measures = view_measures(views, weights)
    cube = cube_directions(sizes.cube)
    rules = [hemisphere_rule(*n, turn=0.5) for n in (sizes.reference, sizes.coarser)]
    matrices = {name: brdf_matrix(brdf, HIGHEST, *sizes.brdf) for name, brdf in brdfs.items()}
    kernels = {
        name: [reflection_kernel(brdf, views, rule) for rule in rules]
        for name, brdf in brdfs.items()
    }
    functions = {p.name: exit_functions(p, views) for p in COMPARED}
    basis = HemisphereBasis(4)
    fit = basis.evaluate(views) @ basis.sample_projection(views, weights).matrix.T
    names = [*functions, FITTED, COARSER, "reference"]
    tallies = {name: {line: Tally() for line in names} for name in brdfs}
    for block in points.blocks(sizes.block):
        t = transfer(block, accelerator, cube, HIGHEST, LIGHT_ORDER, sizes.supersample)
        light = [incident_light(block, accelerator, rule, LIGHT_ORDER) for rule in rules]
        for name in brdfs:
            exact, coarser = (k @ seen for k, seen in zip(kernels[name], light, strict=True))
            tally = tallies[name]
            for projection in COMPARED:
                m = transfer_matrices(projection, matrices[name], t, block.frames)
                difference = functions[projection.name] @ m - exact
                tally[projection.name].add(difference, block.areas, measures)
            tally[FITTED].add(fit @ exact - exact, block.areas, measures)
            tally[COARSER].add(coarser - exact, block.areas, measures)
            tally["reference"].add(exact, block.areas, measures)
    return tallies
