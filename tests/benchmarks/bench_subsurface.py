"""Subsurface scattering: time a vertex as the mesh grows, beside n log n.

Spheres of marble with a mean free path of a twentieth of the radius, three channels.  Rows depend
on nothing but their vertex, so a part of them is timed, in whole chunks from all over the mesh, and
scaled; the octree and the cluster means are timed whole.
"""

import time
from typing import Any

import numpy as np
from harness import Row, in_child

from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.subsurface import VERTICES_PER_CHUNK, SubsurfaceOperator

FULL = (5, 6, 7)
QUICK = (3, 4)
"""Subdivisions: 10,242, 40,962 and 163,842 vertices; 642 and 2,562."""

N_CHUNKS = 6
N_COEFFS = 64
N_PROBES = 16
MOST_GROWTH = 1.25
"""Of the time of n log n: a quarter for what else the machine does."""

MOST_ERROR = 1e-3
"""Squared-error ratio of clusters and cut, of cosine transfer."""


def rows(quick: bool) -> list[Row]:
    """Return the table of this benchmark; the limit on the growth at full size only."""
    found = [in_child(__file__, "measure", subdivisions=s) for s in (QUICK if quick else FULL)]
    table = [
        Row(
            f"subsurface of {of['vertices']} vertices",
            seconds=of["seconds"],
            measured=1e6 * of["seconds"] / of["vertices"],
            unit="us a vertex",
            limit_description=f"{of['entries']:.0f} entries a vertex, {N_COEFFS} coefficients",
            peak_memory_bytes=of["peak_memory_bytes"],
            error=of["error"],
        )
        for of in found
    ]
    first, last = found[0], found[-1]
    expected = _n_log_n(last["vertices"]) / _n_log_n(first["vertices"])
    table += [
        Row(
            f"growth from {first['vertices']} to {last['vertices']}",
            measured=last["seconds"] / first["seconds"] / expected,
            unit="of n log n",
            limit=None if quick else MOST_GROWTH,
            limit_description=f"vertices {last['vertices'] / first['vertices']:.0f} x",
        ),
        Row(
            "error of clusters",
            measured=max(of["error"] for of in found),
            limit=MOST_ERROR,
            limit_description=f"against all triangles, at {N_PROBES} vertices",
        ),
    ]
    return table


def measure(*, subdivisions: int) -> dict[str, Any]:
    """Time the octree, the cluster means and a part of the rows."""
    scene = Scene.from_parts([sphere_mesh(subdivisions)])
    one = Dipole.of_material("marble", mm_per_unit=1.0)
    marble = Dipole.of_material("marble", mm_per_unit=20.0 * float(one.mean_free_path[0]))
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(3, N_COEFFS))
    axes /= np.linalg.norm(axes, axis=0)
    transfer = np.maximum(0.0, scene.normals @ axes).astype(np.float32)
    start = time.perf_counter()
    operator = SubsurfaceOperator(scene, marble)
    sources = operator.sources(transfer)
    set_up = time.perf_counter() - start
    n_verts = scene.n_vertices
    firsts = np.linspace(0, max(0, n_verts - VERTICES_PER_CHUNK), N_CHUNKS).astype(int)
    n_rows = entries = 0
    start = time.perf_counter()
    for first in firsts:
        chunk = np.arange(first, min(first + VERTICES_PER_CHUNK, n_verts))
        block = operator.block(chunk)
        for matrix in block.matrices:
            matrix @ sources
        n_rows += len(chunk)
        entries += block.matrices[0].nnz
    seconds = time.perf_counter() - start
    probes = np.arange(0, n_verts, n_verts // N_PROBES)[:N_PROBES]
    return {
        "vertices": n_verts,
        "seconds": set_up + seconds * n_verts / n_rows,
        "entries": entries / n_rows,
        "error": operator.measured_error(transfer, probes),
    }


def _n_log_n(n: int) -> float:
    return float(n * np.log(n))
