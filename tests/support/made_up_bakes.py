"""Bakes whose errors, bytes and seconds are made up, for searches to choose among."""

import numpy as np

from prtbake_workers.planning.bake_model import BakeModel, Told
from prtbake_workers.planning.bake_search import choose

COARSEST = {12: 3, 42: 5, 162: 9, 642: 17}


def left(n_centres, fine, scale=1.0):
    """What a projection leaves: less with centres, and with directions down to that."""
    return scale * (0.5 / n_centres**0.6) * (1.0 + (COARSEST[n_centres] / fine) ** 2.5)


def trial(*, glossy=True, bounced=False, scales=(1.0, 0.3)):
    terms = [1, 2, 4, 8, 16, 32] if glossy else [1]
    return {
        "parts": [
            {
                "name": "a",
                "n_verts": 2000,
                "shadows": True,
                "even": False,
                "scattered": False,
                "term_bytes": 300.0,
            },
            {
                "name": "b",
                "n_verts": 400,
                "shadows": True,
                "even": True,
                "scattered": False,
                "term_bytes": 0.0,
            },
        ],
        "n_channels": 1,
        "own": {"n_centres": 12, "terms": [4 if glossy else 1, 1]},
        "bake": {"n_centres": 12, "cube_resolution": 8},
        "work": {
            "plan": {"tasks": 1.0, "vertices": 2400.0},
            "join": {"tasks": 1.0, "values": 2400.0 * 12},
        },
        "left_out": 1e-5,
        "options": [
            {
                "term_energy_lost": 0.5 / k**1.5 if glossy else None,
                "n_terms": None,
                "terms": [k, 1],
                "lost": [0.45 / k**1.5 if glossy else 0.0, 0.0],
            }
            for k in terms
        ],
        "fixed_bytes": 20_000,
        "bounced": bounced,
        "cut": None,
        "variances": [0.1, 0.05] if bounced else [],
        "candidates": [
            {
                "n_centres": count,
                "cube_resolution": fine,
                "errors": [left(count, fine, scale) for scale in scales],
            }
            for count, coarsest in COARSEST.items()
            for fine in sorted({coarsest, 24, 48})
        ],
    }


def model_of(**changes):
    return BakeModel(trial(**changes), lambda work: work["bake"]["flops"] / 1e9 + 1.0)


UNTIMED = BakeModel(trial())


def made(model, numbers, *, off=1.0, terms_off=1.0, rest=2e-5, size_off=1.0, slower=1.0):
    """A bake of which predictions are off by factors: ``off`` for all rows, or one for each."""
    at = model.row(numbers)
    off = np.broadcast_to(off, len(model.choices))[at]
    seen = model.foreseen(None, 0.0)
    return Told(
        numbers=numbers,
        projection=tuple(off * seen.projection[at]),
        terms=tuple(terms_off * seen.terms[at]),
        rest=(rest, rest),
        size=round(size_off * seen.sizes[at]),
        seconds=slower * seen.seconds[at],
    )


def searched(model, budget, *, left=None, **off):
    """Go on until the search is over."""
    told = []
    while True:
        choice = choose(model, budget, told, left=left, tolerance=1e-3)
        if choice.numbers is None:
            return told, choice
        told.append(made(model, choice.numbers, **off))
        if left is not None:
            left -= told[-1].seconds
