"""Errors and shares as sentences tell them."""

FEW = 1e-3
"""Below it two decimals of a per cent hold less than two figures."""


def percent(share: float) -> str:
    """Write a share in per cent: two decimals, or three figures of a small one."""
    return f"{100.0 * share:.3g}%" if 0.0 < share < FEW else f"{share:.2%}"
