"""Lists in pages, newest first, and cursors: where the next page starts."""

import base64
import binascii
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import TypeVar

import sqlalchemy as sa
from sqlalchemy.orm import Session

from prtbake_storage.errors import InputError
from prtbake_storage.records.models import JobRow, ResourceRow

Row = TypeVar("Row", JobRow, ResourceRow)


def read_page(
    session: Session,
    row_type: type[Row],
    filters: Sequence[sa.ColumnElement[bool]],
    *,
    cursor: str | None,
    limit: int,
) -> tuple[list[Row], str | None]:
    """Read the rows that pass all filters, ``limit`` a page, and name the next page if any."""
    query = sa.select(row_type).where(*filters)
    if cursor is not None:
        created, row_id = decode_cursor(cursor)
        same_time = sa.and_(row_type.created == created, row_type.id < row_id)
        query = query.where(sa.or_(row_type.created < created, same_time))
    query = query.order_by(row_type.created.desc(), row_type.id.desc()).limit(limit + 1)
    rows = list(session.scalars(query))
    shown = rows[:limit]
    more = encode_cursor(shown[-1].created, shown[-1].id) if len(rows) > limit else None
    return shown, more


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
        # the first hours of year 1 and the last of year 9999 do not exist in every zone
        in_utc = moment.astimezone(UTC)
    except (ValueError, OverflowError, binascii.Error) as error:
        raise InputError(f"not a cursor: {cursor[:100]!r}", pointer="/cursor") from error
    # PostgreSQL's texts cannot hold NUL, and refuse to be compared with it
    if moment.tzinfo is None or "\0" in row_id:
        raise InputError(f"not a cursor: {cursor[:100]!r}", pointer="/cursor")
    return in_utc, row_id
