"""Byte ranges of a download (RFC 9110, section 14)."""

import re
from dataclasses import dataclass

_RANGE = re.compile(r"bytes=(\d*)-(\d*)", re.ASCII)
MAX_DIGITS = 19
"""Digits of 2^63: a longer number is no offset in any file."""


class RangeNotSatisfiable(Exception):
    """No byte of the file lies in the range that was asked for."""


@dataclass(frozen=True)
class ByteRange:
    """Bytes ``start`` to ``stop - 1`` of a file of ``size`` bytes."""

    start: int
    stop: int
    size: int

    @property
    def length(self) -> int:
        """Count of bytes."""
        return self.stop - self.start

    @property
    def content_range(self) -> str:
        """The header that says which part this is."""
        return f"bytes {self.start}-{self.stop - 1}/{self.size}"


def parse_range(header: str | None, size: int) -> ByteRange | None:
    """Read a ``Range`` header; None means the whole file.

    Malformed headers, other units and several ranges at once are ignored, as the RFC allows, and
    give the whole file.

    Raises
    ------
    RangeNotSatisfiable
        When a well-formed range covers no byte.
    """
    match = _RANGE.fullmatch(header.strip()) if header else None
    if match is None:
        return None
    first, last = match[1], match[2]
    if (not first and not last) or max(len(first), len(last)) > MAX_DIGITS:
        return None
    if not first:
        start, stop = max(0, size - int(last)), size
    else:
        start, stop = int(first), min(size, int(last) + 1 if last else size)
        if last and int(last) < start:
            return None
    if start >= stop:
        raise RangeNotSatisfiable
    return ByteRange(start, stop, size)
