"""Cursors: where the next page of a list starts."""

import base64
import binascii
from datetime import datetime

from prtbake_storage.errors import InputError


def encode_cursor(created: datetime, row_id: str) -> str:
    """Name the last row of a page."""
    text = f"{created.isoformat()}|{row_id}"
    return base64.urlsafe_b64encode(text.encode()).decode().rstrip("=")


def decode_cursor(cursor: str) -> tuple[datetime, str]:
    """Read a cursor back; one that we did not write is an `InputError`."""
    try:
        padded = cursor + "=" * (-len(cursor) % 4)
        text = base64.urlsafe_b64decode(padded.encode("ascii")).decode()
        created, row_id = text.split("|", 1)
        moment = datetime.fromisoformat(created)
    except (ValueError, binascii.Error) as error:
        raise InputError(f"not a cursor: {cursor[:100]!r}", pointer="/cursor") from error
    if moment.tzinfo is None:
        raise InputError(f"not a cursor: {cursor[:100]!r}", pointer="/cursor")
    return moment, row_id
