"""What the plan of a scene has to say of its mesh and parts, in words."""

from collections.abc import Sequence
from typing import Any

from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.jobs.materials import PartInput
from prtbake_workers.planning.grain import Grain

REPAIRS = {
    "unreferenced_vertices": "vertices that no face uses were dropped",
    "duplicate_vertices": "duplicate vertices were merged",
    "degenerate_faces": "faces without area were dropped",
    "duplicate_faces": "duplicate faces were dropped",
    "flipped_faces": "faces were turned over",
}
"""What no warning of the report says; its warnings stand beside these."""


def repairs(report: dict[str, Any]) -> list[str]:
    """Say what parsing had to mend in the mesh."""
    return [f"mesh: {report[name]} {what}" for name, what in REPAIRS.items() if report.get(name)]


def unread_tangents(parts: Sequence[PartInput], grain: Sequence[Grain | None]) -> list[str]:
    """Name the parts of the object that ask for tangents which nothing reads."""
    return [
        part.name
        for part, own in zip(parts, grain, strict=True)
        if own is None and part.role == "object" and part.tangents != "horizontal"
    ]


def side_notes(parts: Sequence[PartInput], watertight: bool) -> list[str]:
    """Say which parts are baked on both sides, and for which of them that is for nothing."""
    return [
        f"the mesh is closed: the inside of {part.name} is dark and not seen from outside, and "
        f"two_sided bakes its {part.mesh.n_vertices // 2} vertices for nothing"
        if watertight
        else f"{part.name} has two sides: its {part.mesh.n_vertices // 2} vertices are baked twice"
        for part in parts
        if part.two_sided
    ]


def term_notes(names: Sequence[str], factorisations: Sequence[Factorisation]) -> list[str]:
    """Give what the factorisations have to say of themselves, by part where there are several."""
    return [
        f"{name}: {factorisation.note}" if len(names) > 1 else factorisation.note
        for name, factorisation in zip(names, factorisations, strict=True)
        if factorisation.note
    ]
