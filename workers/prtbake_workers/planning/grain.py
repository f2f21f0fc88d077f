"""The frames of parts whose BRDFs depend on them: what they follow, and where nothing tells."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from prtbake_storage.contract.materials import Tangents
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.tangents import oriented_frames
from prtbake_workers.planning.decision import Decision


@dataclass(frozen=True, eq=False)
class Grain:
    """The grain of one anisotropic part.

    Attributes
    ----------
    part
        Its name.
    tangents
        What they follow.
    frames
        Rows tangent, bitangent, normal.
    n_singular
        Vertices that have the horizontal tangent for want of another.
    first_singular, at
        The first of them and its position; None where there is none.
    """

    part: str
    tangents: Tangents
    frames: Float64[F64, "verts 3 3"]
    n_singular: int
    first_singular: int | None
    at: tuple[float, ...] | None

    @classmethod
    def of(cls, part: str, mesh: Mesh, tangents: Tangents) -> "Grain":
        """Make the frames of a mesh."""
        found = oriented_frames(mesh, tangents)
        first = int(found.singular[0]) if len(found.singular) else None
        at = None if first is None else tuple(float(x) for x in mesh.positions[first])
        return cls(part, tangents, found.frames, len(found.singular), first, at)

    @property
    def along(self) -> str:
        """What the tangents follow, for people."""
        if self.tangents == "uv":
            return "along u of the texture coordinates"
        if self.tangents == "horizontal":
            return "horizontally"
        return f"along ({', '.join(f'{x:g}' for x in self.tangents)})"

    @property
    def singularities(self) -> str | None:
        """What there is to say of vertices without a tangent of their own."""
        if self.first_singular is None or self.at is None:
            return None
        where = ", ".join(f"{x:.4g}" for x in self.at)
        return (
            f"{self.n_singular} of {len(self.frames)} vertices of {self.part} have no tangent "
            f"{self.along} and take the default one, the first is vertex {self.first_singular} at "
            f"({where})"
        )

    def evidence(self) -> dict[str, Any]:
        """Give what a decision rests on."""
        return {
            "part": self.part,
            "tangents": self.tangents,
            "singular": self.n_singular,
            "first_singular": self.first_singular,
            "at": self.at,
        }


def grain_notes(grain: Sequence[Grain | None], unread: Sequence[str]) -> list[str]:
    """Say where tangents are missing, and which isotropic parts ask for some that nothing reads."""
    notes = [own.singularities for own in grain if own is not None and own.singularities]
    return notes + [
        f"the BRDF of {part} is isotropic: its tangents were not read" for part in unread
    ]


def decide_frames(part_terms: Sequence[int], grain: Sequence[Grain | None]) -> Decision:
    """Report on the frames that terms are read in."""
    oriented = [own for own in grain if own is not None]
    reasons = [f"{own.part} is anisotropic, its tangents point {own.along}" for own in oriented]
    reasons += [own.singularities for own in oriented if own.singularities]
    taken = max(part_terms) > 1 or bool(oriented)
    if not reasons:
        turns = "parts with more than one term turn with their frame"
        reasons = [turns if taken else "one term has no azimuth"]
    evidence: dict[str, Any] = {"terms": list(part_terms)}
    if oriented:
        evidence["tangents"] = [own.evidence() for own in oriented]
    return Decision("tangent_frames", taken, False, "; ".join(reasons), evidence)
