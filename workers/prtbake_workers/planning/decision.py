"""What was decided about one effect, and on what grounds."""

from dataclasses import asdict, dataclass
from typing import Any

from prtbake_storage.contract.settings import Switch


@dataclass(frozen=True)
class Decision:
    """One effect: taken or left, by whom, and what the other way would have cost.

    ``predicted_error`` is a squared-error ratio in radiance norm, None where no estimate exists.
    """

    effect: str
    taken: bool
    forced: bool
    reason: str
    evidence: dict[str, Any]
    predicted_error_otherwise: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Give the decision as JSON."""
        return asdict(self)


def settle(switch: Switch, called_for: bool) -> tuple[bool, bool]:
    """Return (taken, forced)."""
    return (called_for, False) if switch == "auto" else (switch == "on", True)
