"""Entity tags and the conditions on them (RFC 9110, section 13)."""

import hashlib


def etag_of(body: bytes) -> str:
    """Return the strong entity tag of a representation."""
    return f'"{hashlib.sha256(body).hexdigest()[:32]}"'


def none_matches(header: str | None, etag: str) -> bool:
    """Whether ``If-None-Match`` names this entity, so that the answer is 304."""
    if header is None:
        return False
    named = [part.strip().removeprefix("W/") for part in header.split(",")]
    return "*" in named or etag in named
