"""How compressions say how far they are."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Takes the fraction done, which never falls, and a word on the state."""


def no_progress(fraction: float, state: str) -> None:
    """Report to nobody."""
